"""Shading: coefficients of 16 bits, the twin's basis, and what is refused."""

import numpy as np
import pytest

from pp_cl.raster.points import SH_BLOCKS
from pp_cl.raster.shade import shade_forward
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import PairedPoints, make_camera, make_points


def shade(dev, sh):
    """(N, 16) features of random points by coefficients; 7 where a point is not listed."""
    n, camera = len(sh[0]), make_camera()
    positions = make_points(np.random.default_rng(1), n)
    scene = PairedPoints(dev, camera, positions, 0.1)
    seen = np.flatnonzero(oracle.kept(camera, positions, 0.1))
    features = dev.upload(np.full((n, 16), 7.0), np.float32)
    sh = [dev.upload(c, c.dtype) for c in sh]
    shade_forward(dev, scene.projected, dev.upload(seen, np.uint32), sh, point_features=features)
    return features.get()


def coefficients(rng, n):
    """Random ones of all degrees."""
    return [np.float32(rng.normal(size=(n, b.count, 16))) for b in SH_BLOCKS]


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_coefficients_of_16_bits(dev, rng, degree):
    """The same features as from their float32 values, to the last bits."""
    sh = [c for c, b in zip(coefficients(rng, 257), SH_BLOCKS, strict=True) if b.degree <= degree]
    sh[0][:3, 0, :4] = [0, -6e-8, 65504, 1e-5]  # denormal halves and the largest
    half = [np.float16(c) for c in sh]
    found = [shade(dev, stored) for stored in (half, [np.float32(c) for c in half])]
    assert np.array_equal(*found) and np.isfinite(found[0]).all() and (found[0] != 7).any()


def test_the_basis_is_orthonormal(rng):
    directions = rng.normal(size=(400_000, 3))
    basis = oracle.sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert np.abs(4 * np.pi * basis.T @ basis / len(basis) - np.eye(9)).max() < 0.02
