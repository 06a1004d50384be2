"""The perceptual term beside what the selftest compares with float64; trainings with it."""

import numpy as np
import pytest
from support.runs import arguments, rows

from pp_cl.cli import main
from pp_cl.device.buffers import table_bytes
from pp_cl.errors import UserError
from pp_cl.metrics.lpips import Lpips
from pp_cl.reference.lpips import WIDTHS, random_weights
from pp_cl.selftest.loss import images
from pp_cl.training.perceptual import PerceptualLoss

WEIGHT = 0.3


@pytest.fixture(scope="module")
def weights():
    """Of a small network of VGG16's shape."""
    return random_weights(np.random.default_rng(5))


def run(loss, prediction, target, offset=(0, 0), start=0.0):
    """(LPIPS, gradient) of a loss added to an array of `start`."""
    grad = loss.dev.upload(np.full(prediction.shape, start), np.float32)
    rows = loss.add_gradient(loss.dev.upload(prediction), loss.dev.upload(target), offset, grad)
    return rows.get().sum(), grad.get()


def test_is_the_metric(dev, rng, weights):
    prediction, target = (np.clip(image, 0, 1) for image in images(rng, 35, 50))
    loss = PerceptualLoss(dev, WEIGHT, weights, "direct")
    found, grad = run(loss, prediction, target)
    assert found == pytest.approx(Lpips(dev, weights).distance(prediction, target), rel=1e-6)
    _, more = run(loss, prediction, target, start=2.0)
    np.testing.assert_array_equal(more, 2 + grad)


@pytest.mark.parametrize(("left", "top"), [(0, 0), (1, 2), (3, 1)])
def test_target_inside_a_larger_prediction(dev, rng, weights, left, top):
    prediction, target = images(rng, 22, 29)
    loss = PerceptualLoss(dev, WEIGHT, weights)
    expected, expected_grad = run(loss, prediction, target)
    padded = np.full((24, 32, 3), np.nan, np.float32)  # poison: nothing outside may be read
    inner = np.s_[top : top + 22, left : left + 29]
    padded[inner] = prediction
    found, grad = run(loss, padded, target, (left, top))
    assert found == expected
    np.testing.assert_array_equal(grad[inner], expected_grad)
    grad[inner] = 0
    assert not grad.any()
    with pytest.raises(ValueError, match="reaches outside"):
        run(loss, padded, target, (4, 0))


@pytest.mark.large
def test_sizes_may_change_between_calls_and_bits_stay(dev, rng, weights):
    loss, seen = PerceptualLoss(dev, WEIGHT, weights), {}
    pairs = [images(rng, *size) for size in [(20, 40), (33, 17)]]
    for i in (0, 1, 0, 1):
        found, grad = run(loss, *pairs[i])
        bits = found.tobytes() + grad.tobytes()
        assert seen.setdefault(i, bits) == bits


@pytest.mark.large
def test_tables_are_what_it_takes(plain, rng, weights):
    before, size = plain.bytes, (64, 40)
    loss = PerceptualLoss(plain, WEIGHT, weights)
    run(loss, *images(rng, *size))
    tables = [PerceptualLoss.table((*size, 3), WIDTHS), Lpips.table(plain, size, WIDTHS)]
    constants = plain.bytes - before - sum(map(table_bytes, tables))
    assert 0 <= constants <= 512  # a row of 32 bytes for each layer whose weights are laid out


def _no_weights():
    raise UserError("LPIPS weights: no network")


# ---- trainings


@pytest.mark.large
def test_a_training_without_it_reads_no_weights(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", _no_weights)
    assert main(arguments(scene, tmp_path / "off")) == 0
    assert all("lpips" not in row for row in rows(tmp_path / "off"))


@pytest.mark.large
def test_a_training_with_it_lowers_it(scene, tmp_path, monkeypatch, weights):
    """The loss holds it and falls, and it is lower than where it is only measured, on the way and
    in the end.
    """
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", lambda: weights)
    found, slowly = {}, {"network__blocks": "double", "network__residual": "false"}
    slowly |= {"train__mask_weight": 0, "train__smooth_l1": 0, "train__spread_weight": 0}
    slowly |= {"raster__radius": 0.75, "train__offset_rate": "0,0"}
    for weight in (1e-9, 0.1):
        out = tmp_path / str(weight)
        assert main(arguments(scene, out, **slowly, train__perceptual_weight=weight)) == 0
        log = [row for row in rows(out) if "loss" in row]
        for row in log:
            parts = row["l1"] + 0.2 * (1 - row["ssim"]) + weight * row["lpips"]
            assert row["loss"] == pytest.approx(parts, rel=1e-5)
        assert np.mean([row["loss"] for row in log[-3:]]) < 0.8 * log[0]["loss"]
        lpips = [row["lpips"] for row in log]
        found[weight] = np.array([np.mean(lpips), np.mean(lpips[-3:])])
    assert (found[0.1] < (0.8, 0.95) * found[1e-9]).all()


@pytest.mark.large
def test_crops_that_are_too_small_are_refused(scene, tmp_path, capsys, monkeypatch, weights):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", lambda: weights)
    crop = {"train__crop": 12, "train__perceptual_weight": 0.1}
    assert main(arguments(scene, tmp_path / "run", **crop)) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "12x12 pixels, LPIPS needs 16x16: raise train.crop" in error
    assert not (tmp_path / "run").exists()


@pytest.mark.large
def test_missing_weights_are_one_line(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", _no_weights)
    words = arguments(scene, tmp_path / "run", train__perceptual_weight=0.1)
    assert main(words) == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith("LPIPS weights: no network")
    assert not (tmp_path / "run").exists()
