"""Alpha and depth from blend weights against float64."""

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.raster.blend import BLENDS
from pp_cl.raster.blend_weights import DROPPED
from pp_cl.raster.depth import depth_forward
from pp_cl.selftest.points import Blended, blend_on_axis, depth_at


def found(dev, scene):
    """(alpha, depth, median), (HW,) each, of a PairedPoints that was blended."""
    arrays = depth_forward(dev, scene.projected, scene.pairs, scene.weights, size=scene.shape)
    assert all(array.shape == scene.shape for array in arrays)
    return [array.get().ravel() for array in arrays]


@pytest.mark.parametrize("rule", BLENDS)
@pytest.mark.parametrize("n", [1, 31, 33, 257])
@pytest.mark.parametrize("drops", [{}, {"tau": 1e-2}])
def test_matches_float64(dev, rng, rule, n, drops):
    blended = Blended(dev, rng, n=n, gamma=0.02, radius=0.4, rule=rule, **drops)
    scene = blended.scene
    alpha, depth, median = found(dev, scene)
    weight = np.where(blended.role == DROPPED, 0, scene.weight()).astype(np.float64)
    z = (blended.positions - scene.camera.eye) @ scene.camera.pose[:, 2]
    total = weight.sum(axis=0)
    hit = total > 0
    assert hit.any() == (n > 1) and not hit.all()
    np.testing.assert_allclose(alpha, np.minimum(total, 1), rtol=1e-5, atol=1e-7)
    assert np.isinf(depth[~hit]).all() and np.isinf(median[~hit]).all()
    mean = (weight * z[:, None]).sum(axis=0)[hit] / total[hit]
    assert relative_error(depth[hit], mean) < 1e-5
    order = np.argsort(np.linalg.norm(blended.positions - scene.camera.eye, axis=1))
    for q in np.flatnonzero(hit):
        listed = order[(blended.geometry["hit"] & (blended.role != DROPPED))[order, q]]
        reached = np.concatenate([[0], np.cumsum(weight[listed, q])])
        depths = np.concatenate([z[listed[:1]], z[listed]])  # the first hit alone has no slope
        near, far = (np.interp(share * total[q], reached, depths) for share in (0.499999, 0.500001))
        low, high = min(near, far), max(near, far)
        assert low - 1e-5 * z.max() <= median[q] <= high + 1e-5 * z.max()


def test_an_opaque_point_hides_what_is_behind(dev):
    scene, _ = blend_on_axis(dev, [0.9, 0.5, 0.1], [0.25, 1.0, 1.0], 0.1, rule="alpha")
    alpha, depth, median = found(dev, scene)
    near, far = depth_at(0.9), depth_at(0.5)
    assert relative_error(alpha, [1.0]) < 1e-6
    assert relative_error(depth, [0.25 * near + 0.75 * far]) < 1e-6
    # a quarter at the first, the second quarter is a third of the second's weight
    assert relative_error(median, [near + (far - near) / 3]) < 1e-6


def test_points_without_opacity_leave_nothing(dev):
    scene, _ = blend_on_axis(dev, [0.9, 0.5], [0.0, 0.0], 0.1, rule="alpha")
    alpha, depth, median = found(dev, scene)
    assert alpha == 0 and np.isinf(depth) and np.isinf(median)
