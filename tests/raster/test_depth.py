"""Alpha and depth from blend weights against float64."""

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.raster.blend import BLENDS
from pp_cl.raster.blend_weights import DROPPED
from pp_cl.raster.depth import depth_forward
from pp_cl.reference import dense
from pp_cl.selftest.points import (
    AXIS_RADIUS,
    Blended,
    PairedPoints,
    blend_on_axis,
    depth_at,
    make_camera,
)


def found(dev, scene):
    """(alpha, depth, median), (HW,) each, of a PairedPoints that was blended."""
    view = scene.projected, scene.pairs, scene.weights
    arrays = depth_forward(dev, *view, footprint=scene.footprint, size=scene.shape)
    assert all(array.shape == scene.shape for array in arrays)
    return [array.get().ravel() for array in arrays]


@pytest.mark.parametrize("rule", BLENDS)
@pytest.mark.parametrize("n", [1, 31, 33, 257])
@pytest.mark.parametrize(
    "drops, kind", [({}, "soft"), ({"tau": 1e-2}, "soft"), ({}, "disc"), ({}, "sphere")]
)
def test_matches_float64(dev, rng, rule, n, drops, kind):
    blended = Blended(dev, rng, n=n, gamma=0.02, rule=rule, kind=kind, **drops)
    scene = blended.scene
    alpha, depth, median = found(dev, scene)
    weight = np.where(blended.role == DROPPED, 0, scene.weight()).astype(np.float64)
    z = dense.surface_depth(scene.camera, blended.geometry, blended.radius, kind)
    total = weight.sum(axis=0)
    hit = total > 0
    assert hit.any() == (n > 1) and not hit.all()
    np.testing.assert_allclose(alpha, np.minimum(total, 1), rtol=1e-5, atol=1e-7)
    assert np.isinf(depth[~hit]).all() and np.isinf(median[~hit]).all()
    mean = (weight * z).sum(axis=0)[hit] / total[hit]
    assert relative_error(depth[hit], mean) < 1e-5
    hits = blended.geometry["hit"] & (blended.role != DROPPED)
    for q in np.flatnonzero(hit):
        order = np.argsort(blended.geometry["depth"][:, q], kind="stable")
        listed = order[hits[order, q]]
        reached = np.concatenate([[0], np.cumsum(weight[listed, q])])
        depths = np.concatenate(
            [z[listed[:1], q], z[listed, q]]
        )  # the first hit alone has no slope
        near, far = (np.interp(share * total[q], reached, depths) for share in (0.499999, 0.500001))
        low, high = min(near, far), max(near, far)
        assert low - 1e-5 * z.max() <= median[q] <= high + 1e-5 * z.max()


def test_an_opaque_point_hides_what_is_behind(dev):
    scene, _ = blend_on_axis(dev, [0.9, 0.5, 0.1], [0.25, 1.0, 1.0], 0.1, rule="alpha")
    alpha, depth, median = found(dev, scene)
    near, far = depth_at(np.array([0.9, 0.5])) - AXIS_RADIUS
    assert relative_error(alpha, [1.0]) < 1e-6
    assert relative_error(depth, [0.25 * near + 0.75 * far]) < 1e-6
    # a quarter at the first, the second quarter is a third of the second's weight
    assert relative_error(median, [near + (far - near) / 3]) < 1e-6


def test_points_without_opacity_leave_nothing(dev):
    scene, _ = blend_on_axis(dev, [0.9, 0.5], [0.0, 0.0], 0.1, rule="alpha")
    alpha, depth, median = found(dev, scene)
    assert alpha == 0 and np.isinf(depth) and np.isinf(median)


def test_soft_points_are_balls(dev, rng):
    """A point's depth is where the pixels' rays enter its ball, by the exact intersection."""
    radius = 0.4
    for position in rng.uniform(-0.5, 0.5, (4, 3)):
        scene = PairedPoints(dev, make_camera(24, 20), position[None], radius)
        scene.blend(np.ones(1), 0.1, np.zeros((1, 16)), rule="alpha")
        alpha, depth, median = found(dev, scene)
        ray = dense.rays(scene.camera)
        centre = dense.camera_space(scene.camera, position[None])[0]
        along = ray @ centre
        across = np.linalg.norm(centre - along[:, None] * ray, axis=1)
        # a pixel's closeness takes its distance at the centre's range, second order in it
        inside = (alpha > 0) & (across < 0.9 * radius)
        assert inside.sum() > 10
        front = (along - np.sqrt(radius**2 - np.minimum(across, radius) ** 2)) * ray[:, 2]
        np.testing.assert_allclose(depth[inside], front[inside], atol=0.05 * radius)
        np.testing.assert_allclose(median[inside], depth[inside], rtol=1e-6)
