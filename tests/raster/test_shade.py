"""Spherical harmonics shading against its float64 twin."""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.raster.sh import SH_BLOCKS
from pp_cl.raster.shade import shade_forward
from pp_cl.reference import dense as oracle
from pp_cl.selftest.points import PairedPoints, make_camera, make_points


class Shaded:
    """Random coefficients of a random scene up to `degree`."""

    def __init__(self, dev, rng, n, degree):
        self.camera, self.positions = make_camera(), make_points(rng, n)
        self.scene = PairedPoints(dev, self.camera, self.positions, 0.1)
        self.sh = [
            np.float32(rng.normal(size=(n, b.count, 16))) for b in SH_BLOCKS if b.degree <= degree
        ]

    def features(self):
        """(N, 16) by the oracle."""
        return oracle.shade(self.positions, self.camera.eye, np.concatenate(self.sh, axis=1))


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_forward(dev, rng, n, degree):
    shaded = Shaded(dev, rng, n, degree)
    kept = np.flatnonzero(oracle.kept(shaded.camera, shaded.positions, 0.1))
    seen = np.sort(rng.choice(kept, (n + 1) // 2, replace=False))
    features = dev.upload(np.full((n, 16), 7.0), np.float32)
    shade_forward(
        dev,
        shaded.scene.projected,
        dev.upload(seen, np.uint32),
        [dev.upload(c) for c in shaded.sh],
        point_features=features,
    )
    assert relative_error(features.get()[seen], shaded.features()[seen]) < 1e-5
    assert (np.delete(features.get(), seen, axis=0) == 7).all()


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_coefficients_of_16_bits(dev, rng, degree):
    """The same features as from their float32 values, to the last bits."""
    shaded = Shaded(dev, rng, 257, degree)
    shaded.sh[0][:3, 0, :4] = [0, -6e-8, 65504, 1e-5]  # denormal halves and the largest
    stored = [np.float16(c) for c in shaded.sh]
    seen = np.flatnonzero(oracle.kept(shaded.camera, shaded.positions, 0.1))
    found = []
    for sh in (stored, [np.float32(c) for c in stored]):
        features = dev.upload(np.full((257, 16), 7.0), np.float32)
        shade_forward(
            dev,
            shaded.scene.projected,
            dev.upload(seen, np.uint32),
            [dev.upload(c, c.dtype) for c in sh],
            point_features=features,
        )
        found.append(features.get())
    assert np.array_equal(*found) and np.isfinite(found[0]).all()


def test_the_basis_is_orthonormal(rng):
    directions = rng.normal(size=(400_000, 3))
    basis = oracle.sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert np.abs(4 * np.pi * basis.T @ basis / len(basis) - np.eye(9)).max() < 0.02


def test_wrong_shapes_are_refused(dev, rng):
    shaded = Shaded(dev, rng, 31, 1)
    with pytest.raises(ValueError, match="sh_1 has shape"):
        shade_forward(
            dev,
            shaded.scene.projected,
            dev.upload(shaded.scene.seen, np.uint32),
            [dev.upload(shaded.sh[0]), dev.empty((31, 5, 16))],
            point_features=dev.empty((31, 16)),
        )


def test_half_a_degree_is_refused(dev, rng):
    shaded = Shaded(dev, rng, 31, 2)
    with pytest.raises(ValueError, match="3 arrays of coefficients end within degree 2"):
        shade_forward(
            dev,
            shaded.scene.projected,
            dev.upload(shaded.scene.seen, np.uint32),
            [dev.upload(c) for c in shaded.sh[:3]],
            point_features=dev.empty((31, 16)),
        )
