"""Which variant a convolution takes: as shipped, as tuned, within the tolerance; whose tuning a
stored one is; and that no run under way notices a new one.
"""

import json

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.runs import arguments, train_and_interrupt
from support.tunings import MS, REL_L2, row, tuning_of

from pp_cl.bench.conv import RandomConv
from pp_cl.bench.timing import errors
from pp_cl.cli import main
from pp_cl.config import Config
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.files.checkpoint import save_checkpoint
from pp_cl.layers.choice import (
    CHOICES,
    ERRORS,
    OFFERED,
    SHIPPED,
    VARIANTS,
    ConvShape,
    can_run,
    fastest,
    load_policy,
    load_tuning,
    make_policy,
    policy_of_run,
    tuning_file,
)
from pp_cl.layers.conv_direct import Direction
from pp_cl.network.unet import UNet

pytestmark = pytest.mark.usefixtures("cpu_form")

DEFAULT = Config().network.tolerance
FORWARD, INPUT, WEIGHTS = Direction
SHAPE = ConvShape(FORWARD, 3, (64,), 32, 64 * 64)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own for every test."""
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    return tmp_path / "cache"


def pick(dev, rows, tolerance=DEFAULT, pixels=64 * 64, ci=64):
    policy = make_policy(dev, tolerance, tuning_of(dev, rows))
    return policy.choose(ConvShape(FORWARD, 3, (ci,), 32, pixels))


# ---- as shipped


@pytest.mark.parametrize("direction", Direction)
def test_the_shipped_choice(dev, monkeypatch, direction):
    def shipped(sources, co, pixels, k=3):
        shape = ConvShape(direction, k, sources, co, pixels)
        assert make_policy(dev, DEFAULT).choose(shape) == make_policy(dev).choose(shape)
        return make_policy(dev).choose(shape)

    least = 64 if direction is WEIGHTS else 900
    assert shipped((128,), 128, least) == "winograd"
    assert shipped((128,), 128, least - 1) == "direct"
    assert shipped((16, 32), 16, 4096) == "winograd"
    for sources, co, k in (((3,), 64, 3), ((64,), 20, 3), ((24, 24), 16, 3), ((128,), 128, 1)):
        assert shipped(sources, co, 4096, k) == "direct"
    assert OFFERED["CPU"] == ("direct", "winograd")
    monkeypatch.setattr(dev, "is_cpu", False)
    assert OFFERED["GPU"] == ("local", "direct")  # one work-item a compute unit suits no GPU
    for k, co in ((3, 128), (3, 3), (1, 64)):
        assert shipped((128,), co, 4096, k) == "local"


def test_a_variant_asked_for_runs_where_it_can(dev):
    policy = make_policy(dev, variant="winograd")
    assert policy.choose(ConvShape(FORWARD, 3, (16,), 16, 64)) == "winograd"
    assert policy.choose(ConvShape(FORWARD, 3, (16, 3), 16, 64)) == "direct"
    with pytest.raises(ValueError, match="fft.*auto, local, direct, winograd"):
        make_policy(dev, variant="fft")


@pytest.mark.parametrize(
    "sources, co, side, k",
    [((16,), 16, 97, 3), ((64, 64), 32, 31, 3), ((512,), 32, 9, 3), ((48,), 3, 64, 1)],
)
@pytest.mark.parametrize("direction", Direction)
def test_shipped_errors_bound_what_is_measured(dev, direction, sources, co, side, k):
    conv = RandomConv(dev, k, side, sources, co=co)
    for name in VARIANTS:
        if can_run(name, k, *sources, co):
            error = errors(*conv.result(name, direction, make_policy(dev)))[0]
            assert error <= ERRORS[name][k][direction], name


def test_what_pp_cl_tune_tries():
    """The shipped value first; Winograd's tiles are multiplied in whole groups."""
    for device_class, choices in CHOICES.items():
        shipped = vars(SHIPPED[device_class])
        assert all(values[0] == shipped[field] for field, values in choices.items())
    for field in ("winograd", "winograd_narrow"):
        assert all(tiles % group == 0 for tiles, group in CHOICES["CPU"][field])


# ---- as tuned


def test_the_fastest_is_taken_and_the_shipped_one_in_doubt():
    assert fastest({"a": 2.0, "b": 1.0}, "a") == "b"
    assert fastest({"a": 1.02, "b": 1.0}, "a") == "a"
    assert fastest({"b": 1.0, "c": 0.99}, "a") == "c"  # the shipped one was not timed
    assert fastest({}, "a") == "a"


def test_a_measured_layer_takes_its_fastest_variant(dev):
    assert pick(dev, [row()]) == "direct"
    # shipped, and hardly slower
    assert pick(dev, [row(ms=MS | {"direct": 1.99})]) == "winograd"
    # of another version
    assert pick(dev, [row(ms=MS | {"fft": 0.1}, rel_l2=REL_L2 | {"fft": 0.0})]) == "direct"
    # all that this layer can run
    assert pick(dev, [row(ms=MS | {"direct": 9.0}, ci=20)], ci=20) == "direct"


def test_other_layers_are_taken_as_shipped(dev):
    assert pick(dev, []) == "winograd"
    for change in ({"ci": 32}, {"co": 64}, {"k": 1}, {"direction": "input"}):
        assert pick(dev, [row(**change)]) == "winograd"


def test_the_nearest_size_counts_within_a_factor_of_four(dev):
    rows = [row(10_000), row(100_000, MS | {"winograd": 0.5})]
    found = {
        pixels: pick(dev, rows, pixels=pixels) for pixels in (2_499, 2_500, 30_000, 32_000, 400_001)
    }
    assert [*found.values()] == ["winograd", "direct", "direct", "winograd", "winograd"]
    rows[1] = row(100_000)
    assert pick(dev, rows, pixels=400_000) == "direct"
    assert pick(dev, rows, pixels=400_001) == "winograd"


def test_a_variant_beyond_the_tolerance_is_not_taken(dev):
    rows = [row(ms=MS | {"winograd": 0.1})]
    assert pick(dev, rows, 5e-7) == "winograd"
    assert pick(dev, rows, 4.9e-7) == "direct"
    assert pick(dev, [], ERRORS["winograd"][3][FORWARD]) == "winograd"
    assert pick(dev, [], ERRORS["direct"][3][FORWARD]) == "direct"


def test_what_no_variant_keeps_is_refused_with_the_least(dev):
    """A number that suffices for all that was measured, whatever convolution is asked for."""
    with pytest.raises(
        UserError, match=r"6e-07: .*64 to 32.*\(forward\).*direct, as shipped.*allow 9e-07"
    ):
        pick(dev, [], 6e-7)
    for exponent in range(-70, -60):
        error = 10 ** (exponent / 10)
        rows = [row(), row(ci=512, rel_l2=dict.fromkeys(VARIANTS, error))]
        for ci in (64, 512):
            with pytest.raises(UserError, match="measured on this device") as refused:
                pick(dev, rows, 1e-8, ci=ci)
            least = float(str(refused.value).split("allow ")[1].split()[0])
            assert error <= least < 1.2 * error or least == 2e-7 > error
            assert {pick(dev, rows, least, ci=c) for c in (64, 512)} <= VARIANTS.keys()


def test_a_network_takes_what_was_tuned(dev, rng):
    """Rows that make one variant the fastest everywhere give the bits of a network of that variant;
    so does a tolerance that one variant alone keeps.
    """
    x = dev.upload(rng.normal(size=(32, 32, 16)).astype(np.float32))

    def image(policy):
        return UNet(dev, (16, 16, 16), policy=policy).forward(x, False).get()

    expected = {variant: image(make_policy(dev, variant=variant)) for variant in OFFERED["CPU"]}
    assert not np.array_equal(*expected.values())
    for variant in expected:
        ms, rel_l2 = MS | {variant: 0.1}, dict.fromkeys(MS, 1e-7)
        rows = [row(side**2, ms, rel_l2, ci=ci, co=16) for side in (8, 16, 32) for ci in (16, 32)]
        tuned = image(make_policy(dev, DEFAULT, tuning_of(dev, rows)))
        np.testing.assert_array_equal(tuned, expected[variant])
    np.testing.assert_array_equal(image(make_policy(dev, 1e-6)), expected["direct"])
    with pytest.raises(UserError, match="tolerance 1e-06.*input"):
        UNet(dev, (16, 16, 16), policy=make_policy(dev, 1e-6)).memory_plan(64, 64, True)


# ---- the file


def test_a_tuning_is_stored_and_read_again(dev, cache, capsys):
    assert load_tuning(dev) is None and capsys.readouterr().err == ""
    tuning = tuning_of(dev, [row()], {"winograd": (32, 8), "direct": (4, 2, (1, 1, 1))})
    write_json(tuning_file(dev), tuning)
    assert load_tuning(dev) == tuning
    policy = load_policy(dev, DEFAULT)
    assert policy.tuning == tuning and str(tuning_file(dev)) in policy.origin
    assert policy.blocking.winograd == (32, 8) and policy.blocking.direct == (4, 2, (1, 1, 1))
    assert policy.choose(SHAPE) == "direct"
    assert tuning_file(dev).parent == cache


@pytest.mark.parametrize("name", ["driver", "compute_units", "name", "platform", "pp_cl"])
def test_a_foreign_devices_tuning_is_not_used(dev, name):
    tuning = tuning_of(dev, [row()])
    tuning["device"][name] = 9999
    write_json(tuning_file(dev), tuning)  # copied here, or measured before an update
    with pytest.warns(UserWarning, match=f"measured with {name} 9999.*pp-cl tune") as warned:
        assert load_tuning(dev) is None
    assert "\n" not in str(warned[0].message)
    with pytest.warns(UserWarning, match="ignored"):
        assert load_policy(dev, DEFAULT).choose(SHAPE) == "winograd"


def test_devices_have_files_of_their_own(dev, monkeypatch):
    mine = tuning_file(dev)
    monkeypatch.setitem(dev.info, "name", "Abacus/../../9000 \u00e4")
    assert tuning_file(dev) != mine and tuning_file(dev).parent == mine.parent


BROKEN = {
    "empty": b"",
    "binary": b"\xff\xfe\x00",
    "cut": b'{"format": 1,',
    "deep": b"[" * 100_000,
    "5000 digits": b'{"format": ' + b"9" * 5000 + b"}",
    "large": b" " * 2**24 + b"{}",
    "out of line": b'{"format": "a\\nb\\u001b[31m"}',
}
NESTED = json.loads("[" * 900 + "]" * 900)


@pytest.mark.parametrize(
    "content",
    [
        *(pytest.param(content, id=name) for name, content in BROKEN.items()),
        {"format": 2},
        {"device": None},
        {"tile_shapes": {"winograd": [63, 7]}},
        {"tile_shapes": {"winograd": [True, 7]}},
        {"tile_shapes": {"winograd": [64.0, 8]}},
        {"tile_shapes": {"winograd": NESTED}},
        {"rows": None},
        {"rows": [{}]},
        {"rows": [row(direction="up")]},
        {"rows": [row(pixels=True)]},
        {"rows": [row(pixels=10**400)]},
        {"rows": [row(ms={}, rel_l2={})]},
        {"rows": [row(rel_l2={"direct": 1e-7})]},
        *(
            {"rows": [row(ms=MS | {"direct": bad})]}
            for bad in (-1, "1", 10**400, 1e300, 5e-324, float("inf"), float("nan"))
        ),
        {"rows": [row(rel_l2=REL_L2 | {"direct": 1e300})]},
    ],
)
def test_a_broken_file_is_ignored_in_one_line(dev, content):
    if isinstance(content, dict):
        content = json.dumps(tuning_of(dev, [row()]) | content).encode()
    tuning_file(dev).write_bytes(content)
    with pytest.warns(UserWarning, match="ignored.*pp-cl tune") as warned:
        assert load_tuning(dev) is None
    (line,) = (str(warning.message) for warning in warned)
    assert str(tuning_file(dev)) in line and line.isprintable() and len(line) < 600


def test_a_file_that_cannot_be_read_is_ignored_in_one_line(dev):
    tuning_file(dev).mkdir()
    with pytest.warns(UserWarning, match="ignored"):
        assert load_tuning(dev) is None


# ---- runs


SHORT = {"train__iterations": 14, "train__previews": 0}


@pytest.fixture
def tuned():
    """A function that stores a tuning which makes "direct" the fastest for the small training."""
    dev = open_device()

    def store():
        rows = [
            row(side**2, MS, REL_L2, direction.value, 3, ci, 16)
            for side in (6, 12, 24)
            for ci in (16, 32)
            for direction in Direction
        ]
        write_json(tuning_file(dev), tuning_of(dev, rows))
        return tuning_file(dev)

    return store


@pytest.mark.slow
def test_tuning_does_not_change_a_run_under_way(scene, tmp_path, monkeypatch, tuned):
    outs = {name: tmp_path / name for name in ("plain", "tuned", "plain cut", "tuned cut")}
    assert main(arguments(scene, outs["plain"], **SHORT)) == 0
    train_and_interrupt(scene, outs["plain cut"], 12, monkeypatch, **SHORT)
    file = tuned()
    assert main(arguments(scene, outs["plain cut"], **SHORT)) == 0
    assert main(arguments(scene, outs["tuned"], **SHORT)) == 0
    train_and_interrupt(scene, outs["tuned cut"], 12, monkeypatch, **SHORT)
    file.unlink()
    assert main(arguments(scene, outs["tuned cut"], **SHORT)) == 0
    bits = {name: (out / "checkpoint.npz").read_bytes() for name, out in outs.items()}
    assert bits["plain cut"] == bits["plain"] and bits["tuned cut"] == bits["tuned"]
    arrays = [
        load_checkpoint(outs[name] / "checkpoint.npz")[1]["net.enc0.a.weight"]
        for name in ("plain", "tuned")
    ]
    assert not np.array_equal(*arrays)  # so that the bits above say something


def test_a_run_of_another_device_takes_the_devices_own(dev):
    tuning = tuning_of(dev, [row()], {"winograd": [32, 8]})
    policy = policy_of_run(dev, DEFAULT, tuning, "run/checkpoint.npz")
    assert policy.tuning == tuning and policy.blocking.winograd == (32, 8)
    assert "tuned, as when the run began" in policy.origin
    updated = tuning | {"device": tuning["device"] | {"driver": "0.1"}}
    # the same device keeps it
    assert policy_of_run(dev, DEFAULT, updated, "run/checkpoint.npz").tuning == updated
    other = tuning | {"device": tuning["device"] | {"name": "Abacus"}}
    policy = policy_of_run(dev, DEFAULT, other, "run/checkpoint.npz")
    assert policy.tuning is None and policy.blocking.winograd == (64, 8)
    assert "as shipped" in policy.origin


def test_a_checkpoint_with_a_broken_tuning_is_refused(scene, tmp_path, monkeypatch, tuned, capsys):
    tuned()
    train_and_interrupt(scene, tmp_path / "run", 11, monkeypatch, **SHORT)
    path = tmp_path / "run" / "checkpoint.npz"
    header, arrays = load_checkpoint(path)
    header.pop("format")
    for broken in ({"device": 1}, {"tile_shapes": {"direct": [9]}}, {}):
        changed = header | {"tuning": header["tuning"] | broken if broken else []}
        save_checkpoint(path, changed, arrays)
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
    for text in ("1e-9", "x", "-1", "2", "nan"):
        assert main(["eval", str(out), "--tolerance", text]) == 2
        assert "tolerance" in capsys.readouterr().err
