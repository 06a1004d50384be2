"""cl/training/smooth.cl against dictionaries and loops."""

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.reference import optim as oracle_optim
from pp_cl.scene.grid import Grid
from pp_cl.training.smooth import Smoother

NONE = 0xFFFFFFFF


def cloud(dev, ids, dims):
    """(device, grid, ids) on the device: the arguments of Smoother."""
    return (
        dev,
        dev.upload(Grid((0, 0, 0), 1, dims).packed()),
        dev.upload(np.asarray(ids, np.uint32)),
    )


def some_ids(rng, n, dims):
    return np.sort(rng.choice(np.prod(dims), n, replace=False)).astype(np.uint32)


def expected_table(ids, dims):
    return [[NONE if j is None else j for j in row] for row in oracle_optim.neighbours(ids, dims)]


def test_full_grid_does_not_wrap(dev):
    dims = (4, 3, 5)
    ids = np.arange(60)
    found = Smoother(*cloud(dev, ids, dims)).neighbours.get()
    np.testing.assert_array_equal(found, expected_table(ids, dims))
    assert (found == NONE).sum() == 2 * (3 * 5 + 4 * 5 + 4 * 3)  # one a face cell


def test_table_of_a_huge_grid(dev):
    """Ids of the largest allowed grid, 2^27 vertices, whose float32 sizes must stay exact."""
    dims = (517, 512, 507)
    last = 517 * 512 * 507 - 1
    ids = [0, 1, 516, 517, 517 * 512 - 1, 517 * 512, last - 517 * 512, last - 517, last - 1, last]
    np.testing.assert_array_equal(
        Smoother(*cloud(dev, ids, dims)).neighbours.get(), expected_table(ids, dims)
    )


@pytest.mark.parametrize("dims", [(6, 5, 40), (3, 2, 100), (40, 30, 1), (600, 1, 1)])
def test_neighbours_are_of_the_other_colour(dev, rng, dims):
    """With an amount that shows every value that is read too early or too late."""
    n = np.prod(dims) * 9 // 10
    ids = some_ids(rng, n, dims)
    values = rng.standard_normal((n, 3, 16)).astype(np.float32)
    sh, expected = dev.upload(values), oracle_optim.smoothed(values, ids, dims, 1.0)
    Smoother(*cloud(dev, ids, dims)).smooth(sh, 1.0)
    assert relative_error(sh.get(), expected) < 5e-7
