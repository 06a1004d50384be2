"""Cases of the metrics: LPIPS, and points against a mesh."""

from itertools import product

import numpy as np

from pp_cl.engine.device.launch import group_ranges, row_parts
from pp_cl.engine.grid import Grid
from pp_cl.metrics.lpips import Lpips, lpips_program
from pp_cl.metrics.shape import Mesh, sample_surface
from pp_cl.reference import lpips
from pp_cl.selftest.case import SIZES, Case, each, exact, relative

BOX = np.array([(x, y, z) for x in (-0.39, 0.39) for y in (-0.29, 0.29) for z in (-0.19, 0.19)])
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def _distance(dev, rng):
    """Features whose lengths differ a millionfold, features of 0, and equal ones."""
    for n, channels in product(SIZES, (16, 512)):
        features = np.maximum(rng.normal(size=(2, n, channels)), 0)
        a, b = (features * 10 ** rng.uniform(-3, 3, (2, n, 1))).astype(np.float32)
        a[0], a[-1] = 0, 0 if n == 1 else b[-1]
        head, distance = rng.uniform(0, 1, channels).astype(np.float32), dev.empty((n,))
        program, ranges = lpips_program(dev), group_ranges(dev, n, row_parts(dev))
        arrays = {"a": dev.upload(a), "b": dev.upload(b), "head": dev.upload(head)}
        program.launch("lpips_distance", *ranges, n=n, c=channels, distance=distance, **arrays)
        # sums over 512 channels in 16 lanes have 32 roundings in sequence, the root one more
        expected = lpips.pixel_distance(*(array.astype(np.float64) for array in (a, b, head)))
        units = [x / np.sqrt((x * x).sum(1, keepdims=True)) for x in (a, b)]
        naive = (units[0] - units[1]) ** 2 @ head
        yield relative(distance.get(), expected, 2e-6, naive=naive)


def _lpips(dev, rng):
    """VGG16's layers with few channels: thirteen convolutions with errors of 3e-6 each."""
    weights = lpips.random_weights(rng)
    for size in ((16, 16), (17, 33)):
        a = rng.uniform(0, 1, (*size, 3))
        b = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)
        yield each(Lpips(dev, weights).distance(a, b), lpips.lpips(a, b, weights), 1e-5)


def _box(dev, rng):
    """Sides of a box at 0.39, 0.29 and 0.19 are nearest to grid layers at 0.35, 0.25 and 0.15."""
    faces = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])
    grid = Grid((-0.45, -0.35, -0.25), 0.1, (10, 8, 6))
    surface = sample_surface(dev, Mesh(BOX, faces), grid, 200_000)
    expected = np.zeros((6, 8, 10), bool)
    expected[1:5, 1:7, 1:9] = True
    expected[2:4, 2:6, 2:8] = False
    ids = grid.ids_of(np.ones(expected.shape, bool))
    yield exact(ids[surface.holds(grid, ids)], grid.ids_of(expected))
    yield exact(surface.count, expected.sum())


CASES = (
    Case("metrics: distance of LPIPS", _distance, hard="no features: 0 / 0"),
    Case("metrics: LPIPS", _lpips),
    Case("metrics: vertices on a box", _box),
)
