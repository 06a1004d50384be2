import numpy as np
import pytest

from pp_cl.engine.raster.depth import depth_forward
from pp_cl.reference import dense
from pp_cl.selftest.points import PairedPoints, make_camera


def test_soft_points_are_balls(dev, rng):
    """A point's depth is where the pixels' rays enter its ball."""
    radius = 0.4
    for position in rng.uniform(-0.5, 0.5, (4, 3)):
        scene = PairedPoints(dev, make_camera(24, 20), position[None], radius)
        scene.blend(np.ones(1), 0.1, np.zeros((1, 16)), rule="alpha")
        arrays = depth_forward(dev, scene.projected, scene.pairs, scene.weights)
        alpha, depth, median = (array.get().ravel() for array in arrays)
        ray = dense.rays(scene.camera)
        centre = dense.camera_space(scene.camera, position[None])[0]
        along = ray @ centre
        across = np.linalg.norm(centre - along[:, None] * ray, axis=1)
        # the falloff takes a pixel's distance at the centre's range: a second-order error
        inside = (alpha > 0) & (across < 0.9 * radius)
        assert inside.sum() > 10
        front = (along - np.sqrt(radius**2 - np.minimum(across, radius) ** 2)) * ray[:, 2]
        np.testing.assert_allclose(depth[inside], front[inside], atol=0.05 * radius)
        np.testing.assert_allclose(median[inside], depth[inside], rtol=1e-6)


@pytest.mark.exact
@pytest.mark.parametrize("side", [1, 2])
def test_a_nan_is_not_hidden(dev, side):
    scene = PairedPoints(dev, make_camera(24, 20), np.zeros((1, 3)), 0.4, supersampling=side)
    scene.blend([np.nan], 0.1, np.zeros((1, 16)), rule="alpha")
    covered = scene.listed.pixel
    assert len(covered) > 10
    for array in depth_forward(dev, scene.projected, scene.pairs, scene.weights):
        assert np.isnan(array.get().ravel()[covered]).all()
