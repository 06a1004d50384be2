"""Models of a few points, and checks of their renderings."""

import weakref

import numpy as np
from scipy.sparse import csr_array

from pp_cl.engine.grid import Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.fragments import list_fragments
from pp_cl.engine.raster.points import PointCloud
from pp_cl.selftest.points import some_ids, some_opacities

GRID = Grid((-0.5, -0.45, -0.4), 0.13, (8, 7, 6))


WIDTHS = (16, 16, 16)


def make_model(dev, rng, n=90):
    """A model with random parameters and some opacities of 0 and 1."""
    ids = some_ids(rng, GRID, n)
    net = UNet(dev, widths=WIDTHS, seed=3)
    model = Model(dev, GRID, (2.0, 6.0), PointCloud.create(dev, ids), net=net)
    opacity = some_opacities(rng, n)
    opacity[:, 0], opacity[::9, 0], opacity[4::9, 0] = rng.uniform(0.2, 1, n), 0, 1
    model.cloud.opacity.set(opacity)
    for array in model.cloud.sh:
        array.set(rng.normal(size=array.shape).astype(np.float32))
    return model


def fetched(arrays):
    """Download {name: DeviceRows}; returns {name: numpy array}."""
    return {name: rows.get() for name, rows in arrays.items()}


def drawn_alone(monkeypatch, renderer):
    """[weak references to all results of renderer.forward() from now on]. Drawing a view while one
    of them is alive fails: device memory would hold the arrays of two views.
    """
    forward, drawn = renderer.forward, []

    def drawing(*args, **named):
        assert not any(result() for result in drawn)
        result = forward(*args, **named)
        drawn.append(weakref.ref(result))
        return result

    monkeypatch.setattr(renderer, "forward", drawing)
    return drawn


def blend_matrix(observation):
    """(HW, N) sparse: the blend weight of each point in each pixel of an Observation."""
    view = observation.view
    listed = list_fragments(view.dev, view.points, view.pairs, view.weights)
    shape = view.pairs.pixels, len(view.points.point_count)
    matrix = csr_array((listed.weight, listed.point.astype(np.int32), listed.offset), shape=shape)
    return matrix[view.cropped(np.arange(shape[0]).reshape(view.size)).ravel()]
