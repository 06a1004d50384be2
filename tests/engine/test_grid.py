import tracemalloc
from fractions import Fraction

import numpy as np
import pytest

from pp_cl.engine.grid import MOST_IDS, Grid, smallest_voxel_size

FAR = np.array([1e6, -1e6, 1e6])


@pytest.fixture
def grid(rng):
    return Grid(tuple(float(x) for x in rng.normal(size=3)), 0.0123456789, (45, 37, 30))


def test_a_rounded_grid_is_the_same_to_float32(grid):
    rounded = grid.rounded()
    assert rounded.voxel_size == np.float32(grid.voxel_size) and rounded.dims == grid.dims
    unit = 2.0**-30  # of a voxel size of 24 bits between 2^-7 and 2^-6
    np.testing.assert_allclose(rounded.origin, grid.origin, rtol=0, atol=unit / 2)
    assert all((Fraction(x) / Fraction(unit)).denominator == 1 for x in rounded.origin)
    assert rounded.rounded() == rounded


@pytest.mark.parametrize("by", [FAR, -FAR], ids=["far", "other way"])
def test_vertices_of_a_rounded_grid_move_exactly(grid, by):
    near = grid.rounded()
    far, ids = near.moved(by), near.ids_of(np.ones(near.dims[::-1], bool))[::7]
    assert (far.positions(ids) - by == near.positions(ids)).all()
    assert (far.centre - by == near.centre).all()
    assert (far.packed(far.centre) == near.packed(near.centre)).all()
    assert (far.refined().centre == far.centre).all()
    exact = [
        Fraction(x) + Fraction(near.voxel_size) * (n - 1) / 2 - Fraction(c)
        for x, n, c in zip(near.origin, near.dims, near.centre, strict=True)
    ]
    assert exact == [0, 0, 0]


def test_a_packed_grid_counts_from_the_centre(grid):
    packed = grid.packed((0.5, -0.25, 1.0))
    assert packed.dtype == np.float32
    np.testing.assert_allclose(packed[:3], np.array(grid.origin) - [0.5, -0.25, 1.0], rtol=1e-6)
    assert packed[3:].tolist() == [np.float32(grid.voxel_size), 45, 37, 30, 0]


@pytest.mark.parametrize("by", [0, FAR])
def test_the_smallest_voxel_size_depends_on_the_size_alone(by):
    box = np.array([[-1.0, -2.0, 0.5], [1.0, 2.0, 0.5]])  # flat
    voxel_size = smallest_voxel_size(box + by, 1000)
    assert voxel_size == pytest.approx(smallest_voxel_size(box, 1000), rel=1e-9)
    assert np.prod(np.maximum(np.ptp(box, axis=0), 0) // voxel_size + 1) <= 1000


def test_a_header_of_huge_integers_is_one_of_floats():
    """JSON writes them without a decimal point, and numpy would keep them as objects."""
    grid = Grid.of_header({"origin": [10**25, 0, -1], "voxel_size": 1, "dims": [2, 3, 4]})
    assert grid == Grid((1e25, 0.0, -1.0), 1.0, (2, 3, 4))
    assert grid.centre.dtype == np.float64 and grid.packed(grid.centre).dtype == np.float32


@pytest.mark.parametrize("dims", [(1, 1, 1), (8, 8, 8), (9, 7, 17), (31, 33, 2), (1, 257, 1)])
def test_ids_number_the_vertices_brick_by_brick(dims):
    grid = Grid((0.5, 1.0, -2.0), 0.25, dims)
    ids = grid.ids_of(np.ones(dims[::-1], bool))
    assert len(ids) == np.prod(dims) and (np.diff(ids.astype(np.int64)) > 0).all()
    assert ids[-1] < grid.id_count <= MOST_IDS
    places = grid.coordinates(ids)
    assert (places >= 0).all() and (places < dims).all()
    assert np.array_equal(grid.ids(places), ids)
    bricks = [tuple(place[::-1] // 8) + tuple(place[::-1] % 8) for place in places]
    assert bricks == sorted(set(bricks)), "bricks, and the vertices in each, x first"
    lattice = grid.lattice()
    assert np.array_equal(lattice[np.lexsort(lattice.T)], lattice), "x first"
    order = np.lexsort(grid.positions(ids).T)
    np.testing.assert_allclose(grid.positions(ids)[order], lattice, rtol=0, atol=1e-12)


def test_small_parts_are_told_from_large_ones():
    grid = Grid((0.0, 0.0, 0.0), 1.0, (9, 8, 7))
    cells = np.zeros((7, 8, 9), bool)
    four, three = [(0, 0, 0), (0, 1, 0), (0, 2, 0), (1, 3, 1)], [(1, 6, 1), (2, 6, 1), (3, 6, 1)]
    for i, j, k in [*four, *three, (8, 7, 6)]:  # the fourth across a corner, the last across bricks
        cells[k, j, i] = True
    ids = grid.ids_of(cells)
    parts = np.select([np.isin(ids, grid.ids(np.array(part))) for part in (four, three)], [4, 3], 1)
    for least, smallest in ((1, 1), (2, 3), (4, 4), (5, 4)):
        assert (grid.in_large_parts(ids, least) == (parts >= smallest)).all()


def test_parts_of_a_wide_box_take_the_memory_of_their_vertices():
    """A thin wide object takes a row and some specks of the 10^9 vertices in its box."""
    grid = Grid((0, 0, 0), 1.0, (1000, 1000, 1000))
    row, specks = [(i, 0, 0) for i in range(500)], [(999, 999, 0), (0, 0, 500), (999, 999, 999)]
    ids = np.sort(grid.ids(np.array(row + specks)))
    of_row = np.isin(ids, grid.ids(np.array(row)))
    tracemalloc.start()
    assert np.array_equal(grid.in_large_parts(ids, 10), of_row)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()
