"""All benches within a budget of time, and what is measured of a training."""

import time

import pytest

from pp_cl.bench import overview, training
from pp_cl.bench.overview import bench_overview, raster_steps, within
from pp_cl.bench.training import bench_training
from pp_cl.layers.choice import make_policy


def steps_of(seconds):
    """Steps that take so long each."""
    for i, duration in enumerate(seconds):
        time.sleep(duration)
        yield [{"step": i}]


@pytest.mark.parametrize(
    ("seconds", "budget", "factor", "expected"),
    [
        ([0, 0, 0], 9, 1, 3),  # all that there are
        ([0.2, 0, 0], 0.1, 1, 1),  # one at least
        ([0.1, 0.1, 0.1], 0.25, 1, 2),
        ([0.1, 0.1, 0.1], 0.25, 3, 1),  # the second would take too long
    ],
)
def test_as_many_steps_as_fit(seconds, budget, factor, expected):
    rows = within(steps_of(seconds), budget, factor)
    assert [row["step"] for row in rows] == list(range(expected))


def test_the_rasteriser_begins_with_what_takes_least(dev, monkeypatch):
    asked = []

    def bench(dev, scene, points, sizes, **options):
        asked.append((points[0], sizes[0]))
        return [{"points": points[0]}]

    monkeypatch.setattr(overview, "bench_raster", bench)
    list(raster_steps(dev))
    assert asked[0] == (10_000, 200) and asked[-1] == (4_000_000, 800)
    assert len(set(asked)) == len(overview.RASTER_SIZES) * len(overview.RASTER_POINTS)


@pytest.mark.slow
def test_a_training_of_the_demo(dev, monkeypatch):
    """As few steps as there may be: the curve ends with the training, the stages of a frame are
    among those of a step.
    """
    monkeypatch.setattr(training, "LEAST_STEPS", 8)
    found = bench_training(dev, 0.0)
    assert found["steps"] == 8 and found["curve"][-1]["step"] == 8
    seconds = [row["seconds"] for row in found["curve"]]
    assert seconds == sorted(seconds) and seconds[0] > 0
    assert all(5 < row["psnr"] < 40 for row in found["curve"])
    assert set(found["frame_ms"]) == {"project", "pairs", "weights", "shade", "blend", "network"}
    assert set(found["frame_ms"]) | {"network backward", "update"} <= set(found["step_ms"])
    counts = found["counts"]
    assert (counts["height"], counts["width"]) == (128, 128)  # the crop of a step
    assert 0 < counts["shaded"] <= counts["points"] == found["points"] and counts["pairs"] > 1000
    for row in (*found["step_ms"].values(), *found["frame_ms"].values()):
        assert 0 < row["least"] <= row["ms"] <= row["most"]


def test_the_least_of_everything(dev, monkeypatch):
    """A budget that is too small still gives a row of each."""
    monkeypatch.setattr(overview, "bench_training", lambda dev, seconds: {"seconds": seconds})
    monkeypatch.setattr(overview, "UNET_SIZES", (16, 32))
    monkeypatch.setattr(overview, "CONV_SIZE", 16)
    monkeypatch.setattr(overview, "WIDTHS", (16, 16, 16))
    told = []
    found = bench_overview(dev, make_policy(dev), 1e-3, told.append)
    assert {row["layer"] for row in found["conv"]} == {"enc0.a"}
    assert {row["shape"][0] for row in found["unet"]} == {16}
    assert {(row["points"] > 9000, row["size"]) for row in found["raster"]} == {(True, 200)}
    assert found["training"]["seconds"] < 1e-3
    assert found["device"] == dev.name and found["seconds"] > 0 and len(told) == 4
    for row in (*found["conv"], *found["unet"], *found["raster"]):
        assert row["ms_range"][0] <= row["ms"] <= row["ms_range"][1]
