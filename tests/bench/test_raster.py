"""pp_cl/bench/raster.py: its float64 values are the oracle's, its numbers are what they say."""

from dataclasses import replace

import numpy as np
import pytest

from pp_cl.bench.raster import bench_raster
from pp_cl.bench.raster_scenes import SCENES
from pp_cl.engine.raster.weights import BLENDS
from pp_cl.reference import dense

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize("rule", BLENDS)
@pytest.mark.parametrize("name", SCENES)
def test_float64_values_of_a_pixel_are_those_by_all_points(dev, name, rule):
    scene = SCENES[name](dev, 400, 16, 0.05)
    geometry = dense.geometry(
        scene.camera,
        scene.positions,
        scene.radius,
        scene.footprint,
        depth_range=scene.depth_range,
    )
    blend = dense.blend_by_rule(rule, geometry, scene.opacity, 0.05)
    everyone = scene.exact_features(np.arange(scene.count))
    if name == "grid":
        sh = np.concatenate([v.get() for v in scene.renderers[rule].model.cloud.sh], 1)
        shaded = dense.shade(scene.positions, scene.camera.eye, sh)
        np.testing.assert_allclose(everyone, shaded, atol=1e-6)
    expected = dense.features(blend, everyone)
    actual = [scene.exact_pixel(rule, pixel % 16, pixel // 16) for pixel in range(256)]
    found = [i for i in range(256) if actual[i] is not None]
    np.testing.assert_allclose([actual[i] for i in found], expected[found], atol=1e-9)
    assert geometry["hit"].any(axis=0)[found].sum() > 50


@pytest.mark.parametrize("offset, clear", [(0.74, True), (0.75, False), (0.76, True)])
def test_pixels_that_rounding_decides_are_left_out(dev, offset, clear):
    """A point whose disc's rim passes through a pixel's centre: 1/1600 of a radian is the width of
    a pixel.
    """
    scene = SCENES["pulsar"](dev, 1, 16, 0.1)
    scene.footprint, scene.radius = "disc", 1e-6
    scene.camera = replace(scene.camera, fx=1600.0, fy=1600.0, cx=8.5, cy=8.5)
    angle = 2 * np.arcsin(offset / 3200)  # the chord to the ray straight ahead is offset / 1600
    scene.positions = 1.5 * np.array([[np.sin(angle), 0, np.cos(angle)]])
    assert (scene.exact_pixel("alpha", 8, 8) is not None) == clear


@pytest.mark.parametrize("name", SCENES)
def test_rows(dev, name):
    rows = list(bench_raster(dev, name, [60, 500], [12, 20], gamma=0.05))
    cases = [(size, blend) for size in (12, 20) for blend in ("alpha", "softmax")]
    assert [(row["size"], row["blend"]) for row in rows] == cases * 2
    assert all(
        abs(row["points"] / n - 1) < 0.25 for row, n in zip(rows, [60] * 4 + [500] * 4, strict=True)
    )
    for row in rows:
        stages = row["stages_ms"]
        assert min(stages.values()) > 0
        assert row["forward_ms"] + row["backward_ms"] == pytest.approx(sum(stages.values()))
        assert row["forward_ms"] > stages["weights"] and row["backward_ms"] >= stages["backward"]
        assert 0 < row["shaded"] <= row["points"] and row["peak_device_bytes"] > 64 * row["points"]
        assert row["max_err"] < 1e-4


def test_a_wrong_picture_is_found(dev):
    scene = SCENES["grid"](dev, 500, 16, 0.05)
    result = scene.forward("softmax")
    assert scene.error("softmax", result) < 1e-4
    features = result.shaded_features.get()[: result.weights.shaded.size, 3]
    span = max(features.max(), 1) - min(features.min(), 1)
    wrong = result.features.get()
    wrong[..., 3] += 0.1
    result.features.set(wrong)
    assert scene.error("softmax", result) == pytest.approx(0.1 / span, rel=1e-2)
