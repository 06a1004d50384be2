"""pp_cl/layers/tuning.py: what a stored tuning makes a convolution take, whose tuning it is, and
that no run under way notices.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from oracle.unet import unet
from support.comparisons import relative_error
from support.conv_layers import layer as layer_weights
from support.runs import arguments, train_and_interrupt
from support.scenes import write_ball_scene
from support.winograd_layers import run_forward, run_weight_gradient

from pp_cl.bench.layer import DIRECTIONS, Layer
from pp_cl.bench.network import errors, plain_parameters
from pp_cl.cli import main
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.files.checkpoint import load_checkpoint, save_checkpoint
from pp_cl.layers.conv import tiling
from pp_cl.layers.tuning import (
    FORMAT,
    Tuning,
    adopt,
    adopt_of_run,
    adopt_stored,
    device_key,
    fastest,
    load_tuning,
    shape_choices,
    tuning_file,
)
from pp_cl.layers.variants import ERRORS, ERRORS_1X1, FASTEST, VARIANTS, offered, pick_variant
from pp_cl.network.unet import UNet

DEFAULT = 1e-5
ORDER = ["winograd4", "winograd2", "direct"]
MS = {"direct": 3.0, "winograd2": 1.0, "winograd4": 2.0}
REL_L2 = {"direct": 2e-7, "winograd2": 1e-7, "winograd4": 5e-7}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own for every test."""
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    return tmp_path / "cache"


@pytest.fixture
def dev(dev):
    """The device, as shipped again after the test."""
    yield dev
    dev.tuning, dev.tile_shapes = None, {}


def row(pixels=64 * 64, ms=MS, rel_l2=REL_L2, direction="forward", k=3, ci=64, co=32):
    return {
        "direction": direction,
        "k": k,
        "ci": ci,
        "co": co,
        "pixels": pixels,
        "ms": ms,
        "rel_l2": rel_l2,
    }


def stored(dev, rows=(), tiles=()):
    """A tuning of this device."""
    return {
        "format": FORMAT,
        "device": device_key(dev),
        "tile_shapes": dict(tiles),
        "rows": list(rows),
    }


def pick(rows, tolerance=DEFAULT, pixels=64 * 64, order=ORDER):
    return Tuning(tolerance, rows).pick("forward", 3, 64, 32, pixels, order)


# ---- the choice


def test_the_fastest_is_taken_and_the_shipped_one_in_doubt():
    assert fastest({"a": 2.0, "b": 1.0}, "a") == "b"
    assert fastest({"a": 1.02, "b": 1.0}, "a") == "a"
    assert fastest({"b": 1.0, "c": 0.99}, "a") == "c"  # the shipped one was not timed
    assert fastest({}, "a") == "a"


def test_a_measured_layer_takes_its_fastest_variant():
    assert pick([row()]) == "winograd2"
    assert pick([row(ms=MS | {"winograd2": 1.99})]) == "winograd4"  # shipped, and hardly slower
    # of another version
    assert pick([row(ms=MS | {"fft": 0.1}, rel_l2=REL_L2 | {"fft": 0.0})]) == "winograd2"
    assert pick([row()], order=["direct"]) == "direct"  # all that this layer can take


def test_other_layers_are_taken_as_shipped():
    assert pick([]) == "winograd4"
    for change in ({"ci": 32}, {"co": 64}, {"k": 1}, {"direction": "input"}):
        assert pick([row(**change)]) == "winograd4"


def test_the_nearest_size_counts_within_a_factor_of_four():
    rows = [row(100, MS | {"direct": 0.1}), row(1000)]
    assert pick(rows, pixels=300) == "direct" and pick(rows, pixels=320) == "winograd2"
    assert pick(rows, pixels=25) == "direct" and pick(rows, pixels=24) == "winograd4"
    assert pick(rows, pixels=4000) == "winograd2" and pick(rows, pixels=4001) == "winograd4"


def test_a_variant_beyond_the_tolerance_is_not_taken():
    assert pick([row(ms=MS | {"winograd4": 0.1})], 5e-7) == "winograd4"
    assert pick([row(ms=MS | {"winograd4": 0.1})], 4.9e-7) == "winograd2"
    assert pick([row(ms=MS | {"direct": 0.1, "winograd4": 0.1})], 1e-7) == "winograd2"
    assert pick([], ERRORS["forward"]["winograd4"]) == "winograd4"
    assert pick([], ERRORS["forward"]["direct"]) == "winograd2"


def test_what_no_variant_keeps_is_refused_with_the_least():
    with pytest.raises(
        UserError,
        match=r"tolerance 6e-07: .*64 to 32.*\(forward\).*winograd2, as shipped.*allow 7e-07",
    ):
        pick([], 6e-7)
    # one more layer, less exact: the number that is named suffices for all
    rows = [row(), row(ci=512, rel_l2=dict.fromkeys(VARIANTS, 3.14159e-7))]
    with pytest.raises(
        UserError, match=r"at least \(winograd2, measured on this device\); allow 3.2e-07 or more"
    ):
        pick(rows, 1e-8)
    assert pick(rows, 3.2e-7) == "winograd2"
    assert Tuning(3.2e-7, rows).pick("forward", 3, 512, 32, 4096, ORDER) in VARIANTS


def test_the_named_least_suffices(dev):
    """Whatever convolution the number is asked for, it lets that one through."""
    for exponent in range(-70, -60):
        error = 10 ** (exponent / 10)
        rows = [row(rel_l2=dict.fromkeys(VARIANTS, error))]
        with pytest.raises(UserError) as refused:
            pick(rows, error * 0.5)
        assert pick(rows, float(str(refused.value).split("allow ")[1].split()[0])) in VARIANTS


def test_shipped_errors_cover_all_variants_and_allow_the_shipped_choice(dev):
    assert ERRORS.keys() == ERRORS_1X1.keys() == FASTEST.keys() == set(DIRECTIONS)
    for direction in FASTEST:
        assert (
            VARIANTS.keys() >= ERRORS[direction].keys() >= {name for _, name in FASTEST[direction]}
        )
        for side in (1, 9, 20, 64):
            adopt(dev, DEFAULT, None)
            taken = pick_variant(dev, direction, 64, 64, side, side)
            dev.tuning = None
            assert taken == pick_variant(dev, direction, 64, 64, side, side)


@pytest.mark.parametrize(
    "sources, co, side, k",
    [
        ((16,), 16, 97, 3),
        ((64, 64), 32, 31, 3),
        ((512,), 32, 9, 3),
        ((48,), 3, 64, 1),
    ],
)
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_shipped_errors_bound_what_is_measured(dev, direction, sources, co, side, k):
    layer = Layer(dev, k, side, sources, co)
    for variant in layer.variants:
        if variant not in ERRORS[direction]:
            continue  # the same kernel as another's
        bound = ERRORS_1X1[direction] if k == 1 else ERRORS[direction][variant]
        assert errors(*layer.result(variant, direction))[0] <= bound


# ---- on a device


def test_a_network_takes_what_was_tuned(dev, rng):
    """Rows that make one variant the fastest everywhere give the bits of a network of that
    variant.
    """
    x = dev.upload(rng.normal(size=(32, 32, 16)).astype(np.float32))
    expected = {
        variant: UNet(dev, (16, 16, 16), variant=variant).forward(x, False).get()
        for variant in offered(dev)
    }
    assert len({image.tobytes() for image in expected.values()}) == len(expected)
    for variant in expected:
        ms = dict.fromkeys(VARIANTS, 2.0) | {variant: 1.0}
        errors = dict.fromkeys(VARIANTS, 1e-7)
        rows = [row(side**2, ms, errors, ci=ci, co=16) for side in (8, 16, 32) for ci in (16, 32)]
        adopt(dev, DEFAULT, stored(dev, rows))
        np.testing.assert_array_equal(
            UNet(dev, (16, 16, 16)).forward(x, False).get(), expected[variant]
        )


def test_a_network_within_a_tolerance(dev, rng):
    x = rng.normal(size=(64, 64, 16)).astype(np.float32)
    adopt(dev, 7e-7, None)
    net = UNet(dev, (16, 16, 16))
    exact = unet(x, plain_parameters(net, net.parameters))[0]
    assert relative_error(net.forward(dev.upload(x), False).get(), exact) < 2e-6
    with pytest.raises(UserError, match="tolerance 7e-07.*input"):
        net.memory_plan(64, 64, True)
    adopt(dev, 1e-9, None)
    with pytest.raises(UserError, match="tolerance 1e-09"):
        net.memory_plan(64, 64, False)


def all_shapes(dev, name):
    """Those of this class of devices and of the other, which are right here too."""
    return list(
        dict.fromkeys(
            [
                *shape_choices(dev)[name],
                *shape_choices(SimpleNamespace(is_cpu=not dev.is_cpu))[name],
            ]
        )
    )


@pytest.mark.parametrize("name", ["winograd", "winograd_weights", "direct"])
def test_every_tile_shape_computes_the_same(dev, name):
    variants = ["direct"] if name == "direct" else ["winograd2", "winograd4"]
    for shape in all_shapes(dev, name):
        adopt(dev, DEFAULT, stored(dev, tiles={name: shape}))
        for sources, co, side in (((32, 16), 32, 13), ((16,), 48, 7), ((16,), 16, 3)):
            layer = Layer(dev, 3, side, sources, co)
            for variant in variants:
                for direction in DIRECTIONS:
                    assert errors(*layer.result(variant, direction))[0] < 2e-6, (
                        shape,
                        variant,
                        direction,
                    )


@pytest.mark.parametrize("name", ["winograd", "winograd_weights"])
def test_every_tile_shape_stays_in_the_memory_it_asks_for(dev, rng, name):
    """Images of more tiles than are taken at a time, and as much scratch memory as these shapes
    need, no more.
    """
    # wide: two full parts of the weights
    x, wide = (rng.normal(size=(50, 31, c)).astype(np.float32) for c in (16, 256))
    weight, bias = layer_weights(rng, 16, 16, 3)
    for shape in all_shapes(dev, name):
        adopt(dev, DEFAULT, stored(dev, tiles={name: shape}))
        for m in (2, 4):
            if name == "winograd":
                assert np.isfinite(run_forward(dev, m, x, weight, bias, False)).all()
            else:
                assert np.isfinite(run_weight_gradient(dev, m, wide[..., :128], wide)[0]).all()
            dev.check()


def test_a_shape_that_does_not_fit_the_channels_or_the_width_is_not_taken(dev):
    adopt(dev, DEFAULT, stored(dev, tiles={"direct": (6, 2, (1, 1, 1))}))
    assert tiling(dev, 100, 64) == tiling(dev, 6, 64) == (6, 2, (1, 1, 1))
    assert tiling(dev, 5, 64) == (4, 2, (1, 1, 1)) and tiling(dev, 3, 64) == (1, 2, (1, 1, 1))
    assert tiling(dev, 100, 48) == (12, 1, (1, 1, 1))  # three blocks of channels do not pair up


@pytest.mark.parametrize(
    "tiles",
    [
        {"winograd": (128, 8), "winograd_weights": 64},
        {"winograd": (32, 8), "direct": (4, 2, (1, 1, 1))},
    ],
)
def test_memory_plan_follows_the_tile_shapes(dev, tiles):
    adopt(dev, DEFAULT, stored(dev, tiles=tiles))
    x, grad_y = dev.zeros((32, 36, 16)), dev.zeros((32, 36, 3))
    before = dev.bytes
    net = UNet(dev, (16, 32, 48))
    net.forward(x)
    net.backward(grad_y)
    assert dev.bytes - before == sum(size for _, _, size in net.memory_plan(32, 36, True))


# ---- the file


def test_stored_and_read_again(dev, cache, capsys):
    assert load_tuning(dev) is None and capsys.readouterr().err == ""
    tuning = stored(dev, [row()], {"winograd": (32, 8), "direct": (4, 2, (1, 1, 1))})
    write_json(tuning_file(dev), tuning)
    assert load_tuning(dev) == tuning
    assert adopt_stored(dev, DEFAULT) == tuning
    assert str(tuning_file(dev)) in capsys.readouterr().out
    assert dev.tile_shapes == tuning["tile_shapes"]
    assert pick_variant(dev, "forward", 64, 32, 64, 64) == "winograd2"
    assert tuning_file(dev).parent == cache


def test_without_one_the_device_class_is_named(dev, monkeypatch, capsys):
    adopt_stored(dev, DEFAULT)
    monkeypatch.setattr(dev, "is_cpu", False)
    adopt_stored(dev, DEFAULT)
    cpu, gpu = capsys.readouterr().out.splitlines()
    assert (
        "CPU" in cpu
        and "no GPU has been measured" in gpu
        and "pp-cl tune" in cpu
        and "pp-cl tune" in gpu
    )
    assert pick_variant(dev, "forward", 64, 64, 64, 64) == "direct"


@pytest.mark.parametrize(
    "name, value",
    [
        ("driver", "9.9"),
        ("compute_units", 10_000),
        ("name", "Abacus"),
        ("platform", "Wood"),
        ("pp_cl", "0.0.0"),
    ],
)
def test_a_foreign_devices_tuning_is_not_used(dev, capsys, name, value):
    tuning = stored(dev, [row()])
    tuning["device"][name] = value
    write_json(tuning_file(dev), tuning)  # copied here, or measured before an update
    assert load_tuning(dev) is None
    line = capsys.readouterr().err
    assert (
        line.count("\n") == 1 and f"measured with {name} {value}" in line and "pp-cl tune" in line
    )
    adopt_stored(dev, DEFAULT)
    assert pick_variant(dev, "forward", 64, 32, 64, 64) == "winograd4"


def test_devices_have_files_of_their_own(dev, monkeypatch):
    mine = tuning_file(dev)
    monkeypatch.setitem(dev.info, "name", "Abacus/../../9000 \u00e4")
    assert tuning_file(dev) != mine and tuning_file(dev).parent == mine.parent


BROKEN = {
    "empty": b"",
    "binary": b"\xff\xfe\x00",
    "cut": b'{"format": 1,',
    "no object": b"[]",
    "null": b"null",
    "other": b'{"a": 1}',
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
def test_a_broken_file_is_ignored_in_one_line(dev, capsys, content):
    tuning_file(dev).write_bytes(content)
    assert load_tuning(dev) is None
    line = capsys.readouterr().err
    assert (
        line.count("\n") == 1
        and str(tuning_file(dev)) in line
        and "ignored" in line
        and "pp-cl tune" in line
    )


def test_a_file_that_cannot_be_read_is_ignored_in_one_line(dev, capsys):
    tuning_file(dev).mkdir()
    assert load_tuning(dev) is None
    assert "ignored" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"device": {}},
        {"device": None},
        {"tile_shapes": {"winograd": [63, 7]}},
        {"tile_shapes": {"fft": [8]}},
        {"tile_shapes": []},
        {"rows": None},
        {"rows": [1]},
        {"rows": [{}]},
        {"rows": [row(direction="up")]},
        {"rows": [row(pixels=0)]},
        {"rows": [row(pixels=2.5)]},
        {"rows": [row(ms={})]},
        {"rows": [row(ms=MS | {"direct": float("nan")})]},
        {"rows": [row(ms=MS | {"direct": -1})]},
        {"rows": [row(ms=MS | {"direct": "1"})]},
        {"rows": [row(rel_l2={"direct": 1e-7})]},
    ],
)
def test_a_tuning_that_cannot_be_is_ignored_in_one_line(dev, capsys, change):
    tuning_file(dev).write_text(json.dumps(stored(dev, [row()]) | change))
    assert load_tuning(dev) is None
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "ignored" in line


# ---- runs


SHORT = {"train__iterations": 20, "train__previews": 0}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Folder of a small scene."""
    return write_ball_scene(tmp_path_factory.mktemp("scene") / "ball")


@pytest.fixture
def tuned():
    """A function that stores a tuning which makes "direct" the fastest for the small training."""
    dev = open_device()

    def store():
        ms = {"direct": 1.0, "winograd2": 2.0, "winograd4": 2.0}
        rows = [
            row(side**2, ms, REL_L2, direction, 3, ci, 16)
            for side in (6, 12, 24)
            for ci in (16, 32)
            for direction in DIRECTIONS
        ]
        write_json(tuning_file(dev), stored(dev, rows))
        return tuning_file(dev)

    return store


def test_tuning_does_not_change_a_run_under_way(scene, tmp_path, monkeypatch, tuned, capsys):
    outs = {name: tmp_path / name for name in ("plain", "tuned", "plain cut", "tuned cut")}
    assert main(arguments(scene, outs["plain"], **SHORT)) == 0
    train_and_interrupt(scene, outs["plain cut"], 15, monkeypatch, **SHORT)
    file = tuned()
    assert main(arguments(scene, outs["plain cut"], **SHORT)) == 0
    assert main(arguments(scene, outs["tuned"], **SHORT)) == 0
    train_and_interrupt(scene, outs["tuned cut"], 15, monkeypatch, **SHORT)
    file.unlink()
    assert main(arguments(scene, outs["tuned cut"], **SHORT)) == 0
    bits = {name: (out / "checkpoint.npz").read_bytes() for name, out in outs.items()}
    assert bits["plain cut"] == bits["plain"] and bits["tuned cut"] == bits["tuned"]
    arrays = {
        name: load_checkpoint(outs[name] / "checkpoint.npz")[1]["net.enc0.a.weight"]
        for name in ("plain", "tuned")
    }
    # so that the bits above say something
    assert not np.array_equal(arrays["plain"], arrays["tuned"])


def test_a_run_of_another_device_takes_the_devices_own(dev, monkeypatch, capsys):
    tuning = stored(dev, [row()], {"winograd": [32, 8]})
    assert adopt_of_run(dev, DEFAULT, tuning, "run/checkpoint.npz") == tuning
    assert (
        dev.tile_shapes == {"winograd": (32, 8)}
        and "tuned, as when the run began" in capsys.readouterr().out
    )
    updated = tuning | {"device": tuning["device"] | {"driver": "0.1"}}
    # the same device keeps it
    assert adopt_of_run(dev, DEFAULT, updated, "run/checkpoint.npz") == updated
    other = tuning | {"device": tuning["device"] | {"name": "Abacus"}}
    assert adopt_of_run(dev, DEFAULT, other, "run/checkpoint.npz") is None
    assert dev.tile_shapes == {} and "as shipped" in capsys.readouterr().out


@pytest.mark.parametrize("broken", [[], {}, {"device": 1}, {"rows": [1]}, {"format": 7}])
def test_a_checkpoint_with_a_broken_tuning_is_refused(
    scene, tmp_path, monkeypatch, tuned, capsys, broken
):
    tuned()
    train_and_interrupt(scene, tmp_path / "run", 12, monkeypatch, **SHORT)
    path = tmp_path / "run" / "checkpoint.npz"
    header, arrays = load_checkpoint(path)
    header.pop("format")
    header["tuning"] = header["tuning"] | broken if broken else broken
    save_checkpoint(path, header, arrays)
    assert main(arguments(scene, tmp_path / "run", **SHORT)) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "its tuning is broken" in line and str(path) in line


def test_tolerance_on_the_command_line(scene, tmp_path, capsys):
    out = tmp_path / "run"
    assert main([*arguments(scene, out, **SHORT), "--tolerance", "1e-9"]) == 2
    assert "tolerance 1e-09" in capsys.readouterr().err and not out.exists()
    assert main([*arguments(scene, out, **SHORT), "--tolerance", "2e-6"]) == 0
    assert json.loads((out / "config.json").read_text())["network"]["tolerance"] == 2e-6
    assert main(["train", scene, "--out", str(out), "--tolerance", "1e-5"]) == 2
    assert "network.tolerance is 2e-06 there" in capsys.readouterr().err
    assert main(["eval", str(out)]) == 0
    capsys.readouterr()
    assert main(["eval", str(out), "--tolerance", "1e-9"]) == 2
    assert "tolerance 1e-09" in capsys.readouterr().err
    for text in ("x", "-1", "2", "nan"):
        assert main(["eval", str(out), "--tolerance", text]) == 2
        assert "--tolerance" in capsys.readouterr().err
