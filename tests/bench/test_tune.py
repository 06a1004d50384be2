"""pp_cl/bench/tune.py: the cases of a network, what is concluded from (invented) times, and the
command as a user meets it.
"""

import json
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from pp_cl.bench import network as bench
from pp_cl.bench import tune
from pp_cl.bench.layer import DIRECTIONS, Layer
from pp_cl.bench.tune import (
    Case,
    measure,
    merge,
    network_cases,
    run_tune,
    summary,
    time_runs,
    tune_layers,
    tune_shapes,
)
from pp_cl.cli import main
from pp_cl.device.discover import TEMPORARY_CACHE, open_device
from pp_cl.errors import UserError
from pp_cl.layers.tuning import Tuning, device_key, load_tuning, shape_choices, tuning_file
from pp_cl.layers.variants import offered

SMALL = ("--size", "8", "--widths", "16,16,16")
CASE = Case("enc0.b", "forward", 3, (16,), 32, 32, 2, True)  # as shipped: winograd4


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own for every test, and short runs."""
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(bench, "SECONDS", 0.0)
    monkeypatch.setattr(bench, "LEAST_ROUNDS", 1)
    return tmp_path / "cache"


@pytest.fixture
def dev(dev):
    """The device, as shipped again after the test."""
    yield dev
    dev.tuning, dev.tile_shapes = None, {}


class Clock:
    """Stands in for bench.interleave: times of one call after the other from `script`, the last one
    for all that follow.

    Variants that the script does not know are slow.
    """

    def __init__(self, monkeypatch, *script):
        self.script, self.calls = list(script), []
        monkeypatch.setattr(tune, "interleave", self)

    def __call__(self, runs, rounds=None):
        self.calls.append((list(runs), rounds))
        times = defaultdict(
            lambda: 9.0, self.script.pop(0) if len(self.script) > 1 else self.script[0]
        )
        for run in runs.values():
            run()
        return {name: [times[name]] * (rounds or 5) for name in runs}


# ---- the cases


def test_cases_of_a_network():
    cases = network_cases((32, 64, 128), 128, 200)
    training = [c for c in cases if c.training]
    by_place = {(c.name, c.direction): c for c in training}
    # and dec0.b
    assert by_place["enc0.b", "forward"] == Case("enc0.b", "forward", 3, (32,), 32, 128, 2, True)
    # dec0.a's two inputs, and those of enc0.b and dec0.b, are one kind of gradient
    assert by_place["enc0.b", "input"] == Case("enc0.b", "input", 3, (32,), 32, 128, 4, True)
    assert by_place["dec0.a", "forward"] == Case("dec0.a", "forward", 3, (32, 32), 32, 128, 1, True)
    assert by_place["up1", "weights"] == Case("up1", "weights", 1, (128,), 64, 32, 1, True)
    assert ("dec0.a", "input") not in by_place
    counts = {d: sum(c.count for c in training if c.direction == d) for d in DIRECTIONS}
    # 13 convolutions, two of two sources
    assert counts == {"forward": 13, "weights": 13, "input": 15}
    evaluation = [c for c in cases if not c.training]
    assert {c.direction for c in evaluation} == {"forward"} and {c.side for c in evaluation} == {
        200,
        100,
        50,
    }
    assert sum(c.count for c in evaluation) == 13
    assert all(c.training for c in network_cases((32, 64, 128), 64, 64))
    assert sum(c.count for c in network_cases((32, 64, 128), 64, 64)) == sum(counts.values())


# ---- what is concluded from times


def test_hopeless_runs_are_not_repeated(monkeypatch):
    clock = Clock(monkeypatch, {"a": 1.0, "b": 3.1, "c": 2.9}, {"a": 5.0, "c": 4.0})
    assert time_runs(dict.fromkeys("abc", lambda: None)) == {"a": 5.0, "b": 3.1, "c": 4.0}
    assert clock.calls == [(["a", "b", "c"], tune.PROBES), (["a", "c"], None)]


def test_one_slow_probe_condemns_nobody(monkeypatch):
    """The best of the probes counts: a machine that was busy for one run is not the variant's
    fault.
    """
    script = [{"a": [1.0, 1.0], "b": [9.0, 0.9]}, {"a": [1.0], "b": [0.9]}]
    monkeypatch.setattr(
        tune,
        "interleave",
        lambda runs, rounds=None: {name: script[rounds is None][name] for name in runs},
    )
    assert time_runs({"a": None, "b": None}) == {"a": 1.0, "b": 0.9}


def test_a_row_says_what_was_measured(dev, monkeypatch):
    clock = Clock(monkeypatch, {"direct": 3.0, "winograd2": 2.0, "winograd4": 1.0})
    row, shipped_ms = measure(dev, CASE, Layer(dev, 3, 32, (16,), 32))
    assert {k: row[k] for k in ("direction", "k", "ci", "co", "pixels")} == {
        "direction": "forward",
        "k": 3,
        "ci": 16,
        "co": 32,
        "pixels": 1024,
    }
    assert (
        row["ms"].items() >= {"direct": 3.0, "winograd2": 2.0, "winograd4": 1.0}.items()
        and shipped_ms == 1.0
    )
    assert row["ms"].keys() == row["rel_l2"].keys() == set(offered(dev))
    assert 0 < row["rel_l2"]["winograd2"] < row["rel_l2"]["winograd4"] < 1e-5
    assert len(clock.calls) == 2  # the shipped one is the fastest: nothing to confirm
    weights, _ = measure(dev, replace(CASE, direction="weights"), Layer(dev, 3, 32, (16,), 32))
    # the others have no kernels of their own
    assert weights["ms"].keys() == {"direct", "winograd2", "winograd4"}


def test_all_that_seem_faster_are_measured_again(dev, monkeypatch):
    """The fastest may be beyond a tolerance, and the next one is then taken."""
    first = {"direct": 0.9, "winograd2": 0.5, "winograd4": 1.0}
    clock = Clock(monkeypatch, first)
    measure(dev, CASE, Layer(dev, 3, 32, (16,), 32))
    assert clock.calls[-1][0] == ["direct", "winograd2", "winograd4"]


@pytest.mark.parametrize("second, taken", [(0.5, "winograd2"), (1.1, "winograd4")])
def test_a_faster_variant_must_be_so_twice(dev, monkeypatch, second, taken):
    first = {"direct": 3.0, "winograd2": 0.5, "winograd4": 1.0}
    clock = Clock(monkeypatch, first, first, first | {"winograd2": second})
    layer = Layer(dev, 3, 32, (16,), 32)
    row, shipped_ms = measure(dev, CASE, layer)
    assert clock.calls[-1][0] == ["winograd2", "winograd4"]
    assert row["ms"].items() >= (first | {"winograd2": second}).items() and shipped_ms == 1.0
    assert tune.picked(dev, CASE, Tuning(1e-5, [row])) == taken


def test_with_tuned_tiles_the_shipped_ones_are_timed_too(dev, monkeypatch):
    dev.tile_shapes = {"winograd": (32, 8)}
    seen = []
    monkeypatch.setattr(
        Layer,
        "runner",
        lambda self, variant, _: lambda: seen.append((variant, dict(self.dev.tile_shapes))),
    )
    monkeypatch.setattr(Layer, "result", lambda self, variant, direction: (np.ones(1), np.ones(1)))
    Clock(monkeypatch, {"direct": 3.0, "winograd2": 2.0, "winograd4": 1.0, None: 1.5})
    row, shipped_ms = measure(dev, CASE, Layer(dev, 3, 32, (16,), 32))
    assert shipped_ms == 1.5 and None not in row["ms"]
    assert ("winograd4", {}) in seen and ("winograd4", {"winograd": (32, 8)}) in seen
    assert dev.tile_shapes == {"winograd": (32, 8)}
    (line,) = summary(dev, [CASE], [row], [shipped_ms], Tuning(1e-5, [row]))
    # the network has the layer twice
    assert "3.00 ms as shipped, 2.00 ms as tuned, 1.50 times as fast" in line


@pytest.mark.parametrize("second, chosen", [(1.0, {"winograd": (128, 8)}), (2.0, {})])
def test_tile_shapes_are_chosen_for_all_layers_together(dev, monkeypatch, capsys, second, chosen):
    shapes = shape_choices(dev)
    first = {shape: 2.0 for of in shapes.values() for shape in of} | {(128, 8): 1.0}
    cases = [
        CASE,
        Case("enc0.b", "weights", 3, (16,), 32, 32, 2, True),
        Case("up0", "forward", 1, (16,), 16, 8, 1, True),
    ]
    clock = Clock(monkeypatch, *[first] * 6, first | {(128, 8): second})
    assert tune_shapes(dev, cases) == chosen
    # two for each of three files, and the pair
    assert clock.calls[-1][0] == [(64, 8), (128, 8)] and len(clock.calls) == 8
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3 and f"128/8 {2 * second:.2f}" in "".join(printed)
    assert ("128/8 2.00 (taken)" in "".join(printed)) == bool(chosen)
    assert dev.tile_shapes == {}


def test_the_table_names_what_is_taken_within_the_tolerance(dev, monkeypatch, capsys):
    Clock(monkeypatch, {"direct": 3.0, "winograd2": 2.0, "winograd4": 1.0})
    for tolerance, end in (
        (1e-5, "winograd4"),
        (2.4e-7, "winograd2 instead of winograd4"),
        (1e-9, "none"),
    ):
        tune_layers(dev, [CASE], tolerance)
        assert capsys.readouterr().out.rstrip().endswith(end)


def test_an_earlier_tuning_of_other_layers_is_kept():
    def of(tiles, *rows):
        rows = [
            {"direction": "forward", "k": 3, "ci": ci, "co": 16, "pixels": 4, "ms": ms}
            for ci, ms in rows
        ]
        return {"tile_shapes": tiles, "rows": rows}

    new = of({}, (16, 1), (32, 2))
    assert merge(new, of({}, (32, 3), (64, 4))) == of({}, (16, 1), (32, 2), (64, 4))
    assert merge(new, of({"winograd": (32, 8)}, (64, 4))) == new  # its times are of other tiles


# ---- the command


def test_tune_stores_what_the_others_then_use(cache, capsys):
    assert main(["tune", *SMALL]) == 0
    dev = open_device()
    tuning = load_tuning(dev)
    assert tuning["device"] == device_key(dev)
    assert {(r["direction"], r["k"], r["pixels"]) for r in tuning["rows"]} >= {
        ("weights", 3, 4),
        ("forward", 1, 64),
    }
    printed = capsys.readouterr().out
    assert (
        str(tuning_file(dev)) in printed
        and "times as fast" in printed
        and printed.count("enc0.a") == 3
    )
    assert [p.name for p in cache.iterdir()] == [tuning_file(dev).name]
    assert main(["bench", "unet", *SMALL]) == 0
    assert f"as tuned, {tuning_file(dev)}" in capsys.readouterr().out
    tuning["device"]["name"] = "Abacus"
    tuning_file(dev).write_text(json.dumps(tuning))
    assert main(["bench", "conv", *SMALL]) == 0
    captured = capsys.readouterr()
    assert "measured with name Abacus" in captured.err and "as shipped" in captured.out
    assert main(["tune", *SMALL, "--preset", "paper"]) == 0  # and is replaced
    assert capsys.readouterr().err == ""
    assert load_tuning(dev)["device"] == device_key(dev)


@pytest.mark.parametrize(
    "words, network",
    [
        ([], ((32, 64, 128), 128, 200)),
        (["--preset", "small"], ((32, 64, 128), 192, 400)),
        (["--preset", "paper"], ((128, 256, 512), 800, 800)),
        (["--size", "64"], ((32, 64, 128), 64, 64)),
        (["--widths", "16,16,32", "--preset", "small"], ((16, 16, 32), 192, 400)),
    ],
)
def test_network_and_sizes_asked_for(monkeypatch, words, network):
    called = []
    monkeypatch.setattr(tune, "run_tune", lambda *args: called.append(args))
    assert main(["tune", *words, "--tolerance", "1e-6", "--device", "0:0"]) == 0
    assert called == [(*network, 1e-6, "0:0")]


@pytest.mark.parametrize(
    "words, named",
    [
        (("--size", "30"), "--size 30"),
        (("--widths", "16,32"), "--widths 16,32"),
        (("--preset", "huge"), "--preset"),
        (("--tolerance", "x"), "--tolerance"),
        (("--tolerance", "-1"), "--tolerance"),
        (("--tolerance", "2"), "--tolerance"),
        (("--tolerance", "nan"), "--tolerance"),
        (("--device", "abacus"), "abacus"),
        (("fast",), "fast"),
    ],
)
def test_bad_input_is_one_line(words, named, capsys, cache):
    assert main(["tune", *SMALL, *words]) == 2
    captured = capsys.readouterr()
    assert named in captured.err and captured.err.count("\n") == 1
    assert not cache.exists() or not list(cache.iterdir())


def test_a_tolerance_that_nothing_keeps_is_refused_and_the_measurement_kept(capsys):
    assert main(["tune", *SMALL, "--tolerance", "1e-12"]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "tolerance 1e-12" in line
    assert load_tuning(open_device())["rows"]
    least = line.rsplit("allow ", 1)[1].split()[0]
    assert main(["tune", *SMALL, "--tolerance", least]) == 0


def test_where_nothing_can_be_stored_nothing_is_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tune, "tune_shapes", lambda *args: pytest.fail("measured"))
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "file" / "cache"))
    assert main(["tune", *SMALL]) == 2
    line = capsys.readouterr().err
    assert "file/cache" in line and "PP_CACHE" in line and line.count("\n") == 1
    monkeypatch.delenv("PP_CACHE")
    temporary = tmp_path / f"{TEMPORARY_CACHE}x"
    temporary.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(temporary))  # as device.py sets it for this process
    with pytest.raises(UserError, match="nothing would be kept; set PP_CACHE"):
        run_tune((16, 16, 16), 8, 8, 1e-5)


def test_bench_conv_takes_no_tolerance_it_would_ignore(capsys):
    assert main(["bench", "conv", *SMALL, "--tolerance", "1e-6"]) == 2
    assert "--tolerance" in capsys.readouterr().err
    assert main(["bench", "unet", *SMALL, "--tolerance", "1e-9"]) == 2
    assert "tolerance 1e-09" in capsys.readouterr().err
