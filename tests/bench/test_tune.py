"""pp_cl/bench/tune.py: the cases of a network, what is concluded from (invented) times, and the
command as a user meets it.
"""

import json
from collections import Counter
from types import SimpleNamespace

import pytest
from support.tunings import row, tuning_of

from pp_cl.bench import timing, tune
from pp_cl.bench.conv import RandomConv
from pp_cl.bench.tune import (
    Case,
    measure,
    merge,
    network_cases,
    time_runs,
    total_times,
    tune_blocking,
)
from pp_cl.cli import main
from pp_cl.device.discover import TEMPORARY_CACHE, open_device
from pp_cl.errors import UserError
from pp_cl.layers.choice import (
    CHOICES,
    OFFERED,
    device_class,
    device_key,
    load_tuning,
    make_policy,
    tuning_file,
)
from pp_cl.layers.conv_direct import Direction
from pp_cl.network.layers import unet_layers

FORWARD, INPUT, WEIGHTS = Direction
SMALL = ("--size", "8", "--widths", "16,16,16")
CASE = Case("enc0.b", FORWARD, 3, (16,), 32, 32, 2, True)  # as shipped: winograd
TUNED = {"winograd": (32, 8)}  # another blocking than the shipped one
MS = {"direct": 2.0, "winograd": 1.0}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own for every test, and short runs."""
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(timing, "SECONDS", 0.0)
    monkeypatch.setattr(timing, "LEAST_ROUNDS", 1)
    return tmp_path / "cache"


@pytest.fixture
def clock(monkeypatch):
    """Stands in for the module time: only what tests say takes time. measurement: number of the
    present call of time_runs(), from 1 on.
    """
    made = SimpleNamespace(now=0.0, measurement=0, sleep=lambda seconds: None)
    made.perf_counter = lambda: made.now
    monkeypatch.setattr(timing, "time", made)

    def counted(runs):
        made.measurement += 1
        return time_runs(runs)

    monkeypatch.setattr(tune, "time_runs", counted)
    return made


@pytest.fixture
def takes(monkeypatch, clock):
    """A function that makes convolutions take ms(variant, blocking, measurement) milliseconds."""
    runner = RandomConv.runner

    def script(ms):
        def timed_runner(self, variant, direction, policy):
            run = runner(self, variant, direction, policy)

            def timed():
                run()
                clock.now += ms(variant, policy.blocking, clock.measurement) * 1e-3

            return timed

        monkeypatch.setattr(RandomConv, "runner", timed_runner)

    return script


def measured(dev, case=CASE, blocking=()):
    """(row, milliseconds as shipped) of a case, with another blocking than the shipped one."""
    conv = RandomConv(dev, case.k, case.side, case.sources, co=case.co)
    tuned = make_policy(dev, None, tuning_of(dev, blocking=blocking))
    return measure(case, conv, make_policy(dev), tuned)


# ---- the cases


def test_cases_of_a_network():
    layers = unet_layers((32, 64, 128), blocks="double")
    cases = network_cases(layers, 128, 200)
    training = [c for c in cases if c.training]
    by_place = {(c.name, c.direction): c for c in training}
    # and dec0.b
    assert by_place["enc0.b", FORWARD] == Case("enc0.b", FORWARD, 3, (32,), 32, 128, 2, True)
    # dec0.a's two inputs, and those of enc0.b and dec0.b, are one kind of gradient
    assert by_place["enc0.b", INPUT] == Case("enc0.b", INPUT, 3, (32,), 32, 128, 4, True)
    assert by_place["dec0.a", FORWARD] == Case("dec0.a", FORWARD, 3, (32, 32), 32, 128, 1, True)
    assert by_place["up1", WEIGHTS] == Case("up1", WEIGHTS, 1, (128,), 64, 32, 1, True)
    assert ("dec0.a", INPUT) not in by_place
    counts = {d: sum(c.count for c in training if c.direction == d) for d in Direction}
    # 13 convolutions, two of two sources
    assert counts == {FORWARD: 13, WEIGHTS: 13, INPUT: 15}
    evaluation = [c for c in cases if not c.training]
    assert {c.direction for c in evaluation} == {FORWARD}
    assert {c.side for c in evaluation} == {200, 100, 50}
    assert sum(c.count for c in evaluation) == 13
    assert all(c.training for c in network_cases(layers, 64, 64))
    assert sum(c.count for c in network_cases(layers, 64, 64)) == sum(counts.values())


# ---- what is concluded from times


def run_for(clock, name, runs, *seconds):
    """A function that takes the next of `seconds`, the last one from then on, and is counted."""

    def run():
        clock.now += seconds[min(runs[name], len(seconds) - 1)]
        runs[name] += 1

    return run


def test_hopeless_runs_are_given_up(clock):
    """By the best of the probes: a machine that was busy for one run is not the variant's fault."""
    runs, seconds = Counter(), {"a": [1], "b": [3.1], "c": [2.9], "d": [1.1, 9, 1.1]}
    made = {name: run_for(clock, name, runs, *times) for name, times in seconds.items()}
    expected = {"a": 1e3, "b": 3.1e3, "c": 2.9e3, "d": 1.1e3}
    assert time_runs(made) == pytest.approx(expected)
    assert runs["b"] < runs["a"] == runs["c"] == runs["d"]


@pytest.mark.usefixtures("cpu_form")
def test_a_row_says_what_was_measured(dev, takes):
    takes(lambda variant, blocking, measurement: MS[variant])
    found, shipped_ms = measured(dev)
    about = [found[name] for name in ("direction", "k", "ci", "co", "pixels")]
    assert about == ["forward", 3, 16, 32, 1024]
    assert found["ms"] == pytest.approx(MS) and shipped_ms == pytest.approx(1.0)
    assert found["ms"].keys() == found["rel_l2"].keys() == set(OFFERED[device_class(dev)])
    assert 0 < found["rel_l2"]["direct"] < found["rel_l2"]["winograd"] < 1e-5


@pytest.mark.usefixtures("cpu_form")
@pytest.mark.parametrize("direct, chosen", [(0.6, "direct"), (1.2, "winograd")])
def test_a_faster_variant_must_be_so_twice(dev, takes, direct, chosen):
    """The times of the second measurement count: of the shipped variant, too."""
    first, second = MS | {"direct": 0.5}, {"direct": direct, "winograd": 1.1}
    takes(lambda variant, blocking, measurement: (first, second)[measurement > 1][variant])
    found, shipped_ms = measured(dev)
    assert found["ms"] == pytest.approx(second) and shipped_ms == pytest.approx(1.1)
    assert make_policy(dev, 1e-5, tuning_of(dev, [found])).choose(CASE.shape) == chosen


@pytest.mark.usefixtures("cpu_form")
def test_with_another_blocking_the_shipped_one_is_timed_too(dev, takes):
    def ms(variant, blocking, measurement):
        shipped = variant == "winograd" and blocking == make_policy(dev).blocking
        return 1.5 if shipped else MS[variant]

    takes(ms)
    found, shipped_ms = measured(dev, blocking=TUNED)
    assert shipped_ms == pytest.approx(1.5) and found["ms"] == pytest.approx(MS)
    policy = make_policy(dev, 1e-5, tuning_of(dev, [found], TUNED))
    # the network has the layer twice
    assert total_times([CASE], [found], [shipped_ms], policy) == {
        "a training step": pytest.approx((3.0, 2.0))
    }


@pytest.mark.usefixtures("cpu_form")
@pytest.mark.parametrize("second, chosen", [(1.0, {"winograd": (128, 8)}), (2.0, {})])
def test_blocking_is_chosen_for_all_layers_together(dev, takes, second, chosen):
    """(128, 8) seems the fastest; only if it is so again it is taken."""
    cases = [
        CASE,
        Case("enc0.b", WEIGHTS, 3, (16,), 32, 32, 2, True),
        Case("up0", FORWARD, 1, (16,), 16, 8, 1, True),
    ]
    fast = []

    def ms(variant, blocking, measurement):
        if variant != "winograd" or blocking.winograd != (128, 8):
            return 2.0
        fast.append(measurement)
        return 1.0 if measurement == fast[0] else second

    takes(ms)
    found, times = tune_blocking(dev, cases, make_policy(dev))
    assert found == chosen and times.keys() == CHOICES["CPU"].keys()
    # the network has the layer twice
    assert times["winograd"][128, 8] == pytest.approx(2 * second)
    assert times["winograd"][64, 8] == pytest.approx(4.0)


@pytest.mark.usefixtures("cpu_form")
def test_the_table_names_what_is_chosen_within_the_tolerance(dev, takes, monkeypatch, capsys):
    takes(lambda variant, blocking, measurement: MS[variant])
    monkeypatch.setattr(tune, "network_cases", lambda *args: [CASE])
    for tolerance, end, status in (
        ("1e-5", "winograd", 0),
        ("2.4e-7", "direct instead of winograd", 0),
        ("1e-9", "none", 2),
    ):
        assert main(["tune", *SMALL, "--tolerance", tolerance]) == status
        lines = capsys.readouterr().out.splitlines()
        (line,) = [x for x in lines if x.startswith("enc0.b")]
        assert line.endswith(end)


def test_an_earlier_tuning_of_other_layers_is_kept():
    def of(blocking, *rows):
        return {"tile_shapes": blocking, "rows": [row(ci=ci, ms=ms) for ci, ms in rows]}

    new = of({}, (16, 1), (32, 2))
    assert merge(new, of({}, (32, 3), (64, 4))) == of({}, (16, 1), (32, 2), (64, 4))
    # its times are of another blocking
    assert merge(new, of({"winograd": (32, 8)}, (64, 4))) == new


# ---- the command


@pytest.mark.usefixtures("cpu_form")
@pytest.mark.slow
def test_tune_stores_what_the_others_then_use(cache, capsys, monkeypatch):
    assert main(["tune", *SMALL]) == 0
    dev = open_device()
    tuning = load_tuning(dev)
    assert tuning["device"] == device_key(dev)
    assert {(r["direction"], r["k"], r["pixels"]) for r in tuning["rows"]} >= {
        ("weights", 3, 4),
        ("forward", 1, 64),
    }
    printed = capsys.readouterr().out
    assert str(tuning_file(dev)) in printed and "times as fast" in printed
    assert printed.count("enc0.a") == 3
    assert [p.name for p in cache.iterdir()] == [tuning_file(dev).name]
    assert main(["bench", "unet", *SMALL]) == 0
    assert f"as tuned, {tuning_file(dev)}" in capsys.readouterr().out
    tuning["device"]["name"] = "Abacus"
    tuning_file(dev).write_text(json.dumps(tuning))
    assert main(["bench", "conv", *SMALL]) == 0
    captured = capsys.readouterr()
    assert "measured with name Abacus" in captured.err and "as shipped" in captured.out
    monkeypatch.setattr(tune, "network_cases", lambda *args: [CASE])
    assert main(["tune", *SMALL, "--preset", "paper"]) == 0  # and is replaced
    assert capsys.readouterr().err == ""
    assert load_tuning(dev)["device"] == device_key(dev)


@pytest.mark.parametrize(
    "words, network",
    [
        ([], ((32, 64, 128), "single", 128, 200)),
        (["--preset", "small"], ((32, 64, 128), "single", 160, 400)),
        (["--size", "64", "--preset", "paper"], ((128, 256, 512), "double", 64, 64)),
        (["--widths", "16,16,32", "--preset", "small"], ((16, 16, 32), "single", 160, 400)),
    ],
)
def test_network_and_sizes_asked_for(monkeypatch, words, network):
    called = []
    monkeypatch.setattr(tune, "network_cases", lambda *args: called.append(args) or [])
    assert main(["tune", *words, "--tolerance", "1e-6"]) == 0
    widths, blocks, *sides = network
    assert called == [(unet_layers(widths, blocks=blocks), *sides)]


def test_a_tolerance_that_nothing_keeps_is_refused_and_the_measurement_kept(capsys, monkeypatch):
    monkeypatch.setattr(tune, "network_cases", lambda *args: [CASE])
    assert main(["tune", *SMALL, "--tolerance", "1e-12"]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "tolerance 1e-12" in line
    assert load_tuning(open_device())["rows"]
    least = line.rsplit("allow ", 1)[1].split()[0]
    assert main(["tune", *SMALL, "--tolerance", least]) == 0


def test_where_nothing_can_be_stored_nothing_is_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tune, "run_tune", lambda *args, **kwargs: pytest.fail("measured"))
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "file" / "cache"))
    assert main(["tune", *SMALL]) == 2
    line = capsys.readouterr().err
    assert "file/cache" in line and "PP_CACHE" in line and line.count("\n") == 1
    monkeypatch.delenv("PP_CACHE")
    temporary = tmp_path / f"{TEMPORARY_CACHE}x"
    temporary.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(temporary))  # as device.py sets it for this process
    with pytest.raises(UserError, match="PP_CACHE"):
        tune.check_cache()
