"""pp_cl/bench/raster.py: its errors and numbers are what they say."""

import pytest

from pp_cl.bench.raster import BLENDS, SCENES, bench_raster, features_error

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize("name", SCENES)
def test_rows(dev, name):
    rows = list(bench_raster(dev, name, [60, 500], [12, 20]))
    cases = [(size, blend) for size in (12, 20) for blend in BLENDS]
    assert [(row["size"], row["blend"]) for row in rows] == cases * 2
    assert all(
        abs(row["points"] / n - 1) < 0.25 for row, n in zip(rows, [60] * 4 + [500] * 4, strict=True)
    )
    for row in rows:
        stages = row["stages_ms"]
        assert min(stages.values()) > 0
        assert row["forward_ms"] + row["backward_ms"] == pytest.approx(sum(stages.values()))
        assert row["forward_ms"] > stages["weights"] and row["backward_ms"] >= stages["backward"]
        assert 0 < row["visible"] <= row["points"] and row["peak_device_bytes"] > 64 * row["points"]
        assert 0 < row["max_err"] < 1e-4


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("blend", BLENDS)
def test_a_wrong_image_is_found(dev, name, blend):
    scene = SCENES[name](dev, 500, 16)
    features = scene.forward(blend).features.get()
    assert features_error(scene, blend, features) < 1e-4
    of_points = scene.exact_features()[:, 3]
    features[..., 3] += 0.1
    span = max(of_points.max(), 1) - min(of_points.min(), 1)
    assert features_error(scene, blend, features) == pytest.approx(0.1 / span, rel=1e-2)
