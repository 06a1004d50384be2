"""pp_cl/layers/tuning.py: whose tuning a stored one is, and that no run under way notices a new
one.
"""

import json

import numpy as np
import pytest
from support.runs import arguments, train_and_interrupt
from support.tunings import MS, REL_L2, row, tuning_of

from pp_cl.cli import main
from pp_cl.device.discover import open_device
from pp_cl.files.atomic import write_json
from pp_cl.files.checkpoint import load_checkpoint, save_checkpoint
from pp_cl.layers.choice import ConvShape, load_policy, load_tuning, policy_of_run, tuning_file
from pp_cl.layers.conv import Direction

pytestmark = pytest.mark.usefixtures("cpu_form")

DEFAULT = 1e-5
SHAPE = ConvShape(Direction.FORWARD, 3, (64,), 32, 64 * 64)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own for every test."""
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    return tmp_path / "cache"


# ---- the file


def test_stored_and_read_again(dev, cache, capsys):
    assert load_tuning(dev) is None and capsys.readouterr().err == ""
    tuning = tuning_of(dev, [row()], {"winograd": (32, 8), "direct": (4, 2, (1, 1, 1))})
    write_json(tuning_file(dev), tuning)
    assert load_tuning(dev) == tuning
    policy = load_policy(dev, DEFAULT)
    assert policy.tuning == tuning and str(tuning_file(dev)) in policy.origin
    assert policy.blocking.winograd == (32, 8) and policy.blocking.direct == (4, 2, (1, 1, 1))
    assert policy.choose(SHAPE) == "winograd2"
    assert tuning_file(dev).parent == cache


def test_without_one_the_device_class_is_named(dev, monkeypatch):
    cpu = load_policy(dev, DEFAULT).origin
    monkeypatch.setattr(dev, "is_cpu", False)
    policy = load_policy(dev, DEFAULT)
    gpu = policy.origin
    assert (
        "CPU" in cpu
        and "through local memory; no GPU has been measured" in gpu
        and "pp-cl tune" in cpu
        and "pp-cl tune" in gpu
    )
    assert policy.choose(SHAPE) == "local"


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
def test_a_foreign_devices_tuning_is_not_used(dev, name, value):
    tuning = tuning_of(dev, [row()])
    tuning["device"][name] = value
    write_json(tuning_file(dev), tuning)  # copied here, or measured before an update
    with pytest.warns(UserWarning, match=f"measured with {name} {value}.*pp-cl tune") as warned:
        assert load_tuning(dev) is None
    assert "\n" not in str(warned[0].message)
    with pytest.warns(UserWarning, match="ignored"):
        assert load_policy(dev, DEFAULT).choose(SHAPE) == "winograd4"


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
    "deep": b"[" * 100_000,
    "5000 digits": b'{"format": ' + b"9" * 5000 + b"}",
    "large": b" " * 2**24 + b"{}",
    "out of line": b'{"format": "a\\nb\\u001b[31m"}',
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
def test_a_broken_file_is_ignored_in_one_line(dev, content):
    tuning_file(dev).write_bytes(content)
    with pytest.warns(UserWarning, match="ignored.*pp-cl tune") as warned:
        assert load_tuning(dev) is None
    (line,) = (str(warning.message) for warning in warned)
    assert str(tuning_file(dev)) in line and line.isprintable() and len(line) < 600


def test_a_file_that_cannot_be_read_is_ignored_in_one_line(dev):
    tuning_file(dev).mkdir()
    with pytest.warns(UserWarning, match="ignored"):
        assert load_tuning(dev) is None


def deep(levels):
    """A list in a list in a list."""
    found = []
    for _ in range(levels):
        found = [found]
    return found


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
        {"rows": [row(pixels=10**400)]},
        {"rows": [row(pixels=True)]},
        {"rows": [row(ms=MS | {"direct": 10**400})]},
        {"rows": [row(ms=MS | {"direct": 1e300})]},
        {"rows": [row(ms=MS | {"direct": float("inf")})]},
        {"rows": [row(rel_l2=REL_L2 | {"direct": 5e-324})]},
        {"rows": [row(rel_l2=REL_L2 | {"direct": 1e300})]},
        {"rows": [row(direction=["forward"])]},
        {"rows": {}},
        {"rows": "fast"},
        {"tile_shapes": {"winograd": [True, 7]}},
        {"tile_shapes": {"winograd": [64.0, 8]}},
        {"tile_shapes": {"winograd": deep(900)}},
        {"tile_shapes": None},
    ],
)
def test_a_tuning_that_cannot_be_is_ignored_in_one_line(dev, change):
    tuning_file(dev).write_text(json.dumps(tuning_of(dev, [row()]) | change))
    with pytest.warns(UserWarning, match="ignored") as warned:
        assert load_tuning(dev) is None
    assert "\n" not in str(warned[0].message)


# ---- runs


SHORT = {"train__iterations": 20, "train__previews": 0}


@pytest.fixture
def tuned():
    """A function that stores a tuning which makes "direct" the fastest for the small training."""
    dev = open_device()

    def store():
        ms = {"direct": 1.0, "winograd2": 2.0, "winograd4": 2.0}
        rows = [
            row(side**2, ms, REL_L2, direction.value, 3, ci, 16)
            for side in (6, 12, 24)
            for ci in (16, 32)
            for direction in Direction
        ]
        write_json(tuning_file(dev), tuning_of(dev, rows))
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
