"""All benches within a budget of time."""

import time

import pytest

from pp_cl.bench import overview, raster, timing
from pp_cl.bench.overview import bench_overview, raster_steps, within


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
    rows = list(within(steps_of(seconds), budget, factor))
    assert [row["step"] for row in rows] == list(range(expected))


def test_the_rasteriser_begins_with_what_takes_least(dev, monkeypatch):
    asked = []

    def bench(dev, scene, points, sizes, **options):
        asked.append((points[0], sizes[0]))
        return [{"points": points[0]}]

    monkeypatch.setattr(raster, "bench_raster", bench)
    list(raster_steps(dev))
    assert asked[0] == (10_000, 200) and asked[-1] == (4_000_000, 800)
    assert len(set(asked)) == len(overview.RASTER_SIZES) * len(overview.RASTER_POINTS)


def test_the_least_of_everything(dev, monkeypatch):
    """A budget that is too small still gives a row of each, which is printed as it is measured."""
    training = {"curve": [{"step": 9, "seconds": 4.5, "psnr": 21.25}], "step_ms": {}}
    monkeypatch.setattr(overview, "bench_demo", lambda dev, s: training | {"seconds": s})
    monkeypatch.setattr(overview, "UNET_SIZES", (16, 32))
    monkeypatch.setattr(overview, "CONV_SIZE", 16)
    monkeypatch.setattr(overview, "WIDTHS", (16, 16, 16))
    told = []
    found = bench_overview(dev, 1e-3, told.append)
    assert {(row["layer"], row["direction"]) for row in found["conv"]} == {("enc0.a", "forward")}
    assert {row["shape"][0] for row in found["unet"]} == {16}
    assert {(row["points"] > 9000, row["size"]) for row in found["raster"]} == {(True, 200)}
    assert found["training"]["seconds"] < 1e-3
    printed = [*map(timing.line, found["conv"] + found["unet"]), *map(raster.line, found["raster"])]
    assert set(printed) < set(told) and "21.25" in " ".join(told)
