"""Harmonics that reproduce the images."""

import numpy as np
import pytest

from pp_cl.export.harmonics import basis, fit_harmonics
from pp_cl.export.observe import Observation, directions, observe
from pp_cl.files.picture import Picture


def test_the_functions_of_the_basis_are_orthogonal():
    directions_ = np.random.default_rng(0).normal(size=(200_000, 3))
    values = basis(directions_ / np.linalg.norm(directions_, axis=1, keepdims=True))
    product = values.T @ values / len(values)
    off_diagonal = product - np.diag(np.diag(product))
    assert values.shape == (200_000, 9) and np.diag(product).min() > 0.05
    assert np.abs(off_diagonal).max() < 0.01


def drawn(run, coefficients, seen):
    """(HW, 3): coefficients (N, 9, 3), blended over white."""
    positions = run.model.positions()
    at, matrix = basis(directions(positions, seen.camera)), seen.blend_matrix()
    return matrix @ np.einsum("nk,nkc->nc", at, coefficients) + (1 - matrix.sum(1))[:, None]


def test_images_of_known_harmonics_are_reproduced(run, rng, monkeypatch):
    n = run.model.cloud.count
    known = np.concatenate(
        [np.full((n, 1, 3), 0.5), rng.normal(scale=0.02, size=(n, 8, 3))], axis=1
    ).astype(np.float32)

    def picture(self):
        image = drawn(run, known, self).reshape(30, 30, 3)
        alpha = self.blend_matrix().sum(1).reshape(30, 30)
        return Picture(image, alpha, alpha, alpha)

    with monkeypatch.context() as patch:
        patch.setattr(Observation, "picture", picture)
        found = fit_harmonics(run)
    for seen in observe(run, run.cameras("train")[::4], ""):
        error = np.abs(drawn(run, found, seen) - drawn(run, known, seen))
        assert error.mean() < 0.005


def test_the_runs_own_images_are_reproduced(run):
    found = fit_harmonics(run)
    assert found.dtype == np.float32 and np.isfinite(found).all()
    for seen in observe(run, run.cameras("train")[::4], ""):
        error = drawn(run, found, seen).clip(0, 1) - seen.picture().colour.reshape(-1, 3)
        assert -10 * np.log10(np.mean(error**2)) > 25


def test_points_that_no_view_shows_keep_zero(run):
    found = fit_harmonics(run)
    weights = sum(seen.point_weights() for seen in observe(run, run.cameras("train"), ""))
    hidden = weights == 0
    assert found[hidden] == pytest.approx(0)
    assert np.abs(found[~hidden]).max() > 0.1
