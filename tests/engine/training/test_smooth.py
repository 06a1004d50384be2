from itertools import product

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.engine.grid import Grid
from pp_cl.engine.training.smooth import Smoother
from pp_cl.reference import optim as oracle_optim
from pp_cl.selftest.points import some_ids

NONE = 0xFFFFFFFF


def cloud(dev, ids, grid):
    return dev, dev.upload(grid.packed()), dev.upload(ids, np.uint32)


def expected_table(vertices):
    return [[NONE if j is None else j for j in row] for row in oracle_optim.neighbours(vertices)]


def test_full_grid_does_not_wrap(dev):
    for dims in ((4, 3, 5), (8, 9, 17)):
        grid = Grid((0, 0, 0), 1, dims)
        ids = grid.ids_of(np.ones(dims[::-1], bool))
        found = Smoother(*cloud(dev, ids, grid)).neighbours.get()
        np.testing.assert_array_equal(found, expected_table(grid.coordinates(ids)))
        nx, ny, nz = dims
        assert (found == NONE).sum() == 2 * (nx * ny + ny * nz + nz * nx)  # one a face cell


def test_table_of_a_huge_grid(dev):
    for dims in ((517, 512, 507), (1620, 1620, 1620)):
        grid = Grid((0, 0, 0), 1, dims)
        assert grid.id_count <= 2**32
        corners = np.array(list(product(*((0, 1, n // 2, n // 2 + 1, n - 2, n - 1) for n in dims))))
        ids = np.sort(grid.ids(corners))
        np.testing.assert_array_equal(
            Smoother(*cloud(dev, ids, grid)).neighbours.get(),
            expected_table(grid.coordinates(ids)),
        )


@pytest.mark.parametrize("dims", [(6, 5, 40), (3, 2, 100), (40, 30, 1), (600, 1, 1)])
def test_neighbours_are_of_the_other_colour(dev, rng, dims):
    n, grid = np.prod(dims) * 9 // 10, Grid((0, 0, 0), 1, dims)
    ids = some_ids(rng, grid, n)
    values = rng.standard_normal((n, 3, 16)).astype(np.float32)
    sh, expected = dev.upload(values), oracle_optim.smoothed(values, grid.coordinates(ids), 1.0)
    Smoother(*cloud(dev, ids, grid)).smooth(sh, 1.0)
    assert relative_error(sh.get(), expected) < 5e-7
