from itertools import product

import numpy as np

from pp_cl.engine.grid import Grid
from pp_cl.engine.training.smooth import Smoother
from pp_cl.reference import optim as oracle_optim


def test_table_of_a_huge_grid(dev):
    for dims in ((517, 512, 507), (1620, 1620, 1620)):
        grid = Grid((0, 0, 0), 1, dims)
        assert grid.id_count <= 2**32
        corners = np.array(list(product(*((0, 1, n // 2, n // 2 + 1, n - 2, n - 1) for n in dims))))
        ids = np.sort(grid.ids(corners))
        smoother = Smoother(dev, dev.upload(grid.packed()), dev.upload(ids, np.uint32))
        table = oracle_optim.neighbours(grid.coordinates(ids))
        expected = [[2**32 - 1 if j is None else j for j in row] for row in table]
        np.testing.assert_array_equal(smoother.neighbours.get(), expected)
