"""cl/training/perceptual.cl and the gradient of LPIPS against float64; trainings with it."""

import json

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES, large
from support.runs import arguments

from pp_cl.cli import main
from pp_cl.device.buffers import table_bytes
from pp_cl.errors import UserError
from pp_cl.layers.choice import make_policy
from pp_cl.metrics.lpips import Lpips
from pp_cl.reference.lpips import WIDTHS, lpips, lpips_gradient, random_weights
from pp_cl.training.perceptual import PerceptualLoss

SIZES = [(16, 16), (17, 33), large((39, 31)), large((16, 257))]
WEIGHT = 0.3


@pytest.fixture(scope="module")
def weights():
    """Of a small network of VGG16's shape."""
    return random_weights(np.random.default_rng(5))


def images(rng, height, width):
    """A target in [0, 1], and a prediction that leaves it."""
    target = rng.uniform(0, 1, (height, width, 3))
    prediction = target + rng.normal(0, 0.2, target.shape)
    return prediction.astype(np.float32), target.astype(np.float32)


def run(loss, prediction, target, offset=(0, 0), start=0.0):
    """(terms, gradient) of a loss added to arrays of `start`."""
    terms = loss.dev.upload(np.full(4, start), np.float32)
    grad = loss.dev.upload(np.full(prediction.shape, start), np.float32)
    images = loss.dev.upload(prediction), loss.dev.upload(target)
    loss.add(*images, offset, grad_prediction=grad, terms=terms)
    return terms.get(), grad.get()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("variant", ["auto", "direct"])
def test_matches_oracle(dev, rng, weights, size, variant):
    prediction, target = images(rng, *size)
    loss = PerceptualLoss(dev, WEIGHT, make_policy(dev, variant=variant), weights)
    terms, grad = run(loss, prediction, target)
    exact = prediction.astype(np.float64), target.astype(np.float64)
    expected = lpips(*exact, weights)
    assert expected > 0.01
    assert loss.terms()["lpips"].get() == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(terms, [WEIGHT * expected, 0, 0, 0], rtol=1e-5)
    assert relative_error(grad, WEIGHT * lpips_gradient(*exact, weights)) < 1e-5


def test_is_the_metric(dev, rng, weights):
    prediction, target = (np.clip(image, 0, 1) for image in images(rng, 35, 50))
    loss = PerceptualLoss(dev, WEIGHT, make_policy(dev, variant="direct"), weights)
    run(loss, prediction, target)
    expected = Lpips(dev, weights).distance(prediction, target)
    assert loss.terms()["lpips"].get() == pytest.approx(expected, rel=1e-6)


def test_adds_to_the_loss_and_to_its_gradient(dev, rng, weights):
    prediction, target = images(rng, 20, 31)
    loss = PerceptualLoss(dev, WEIGHT, make_policy(dev), weights)
    terms, grad = run(loss, prediction, target)
    more_terms, more_grad = run(loss, prediction, target, start=2.0)
    np.testing.assert_array_equal(more_terms, 2 + terms)
    np.testing.assert_array_equal(more_grad, 2 + grad)


@pytest.mark.parametrize(("left", "top"), [(0, 0), (1, 2), (3, 1)])
def test_target_inside_a_larger_prediction(dev, rng, weights, left, top):
    prediction, target = images(rng, 22, 29)
    loss = PerceptualLoss(dev, WEIGHT, make_policy(dev), weights)
    expected_terms, expected_grad = run(loss, prediction, target)
    padded = np.full((24, 32, 3), np.nan, np.float32)  # poison: nothing outside may be read
    inner = np.s_[top : top + 22, left : left + 29]
    padded[inner] = prediction
    terms, grad = run(loss, padded, target, (left, top))
    np.testing.assert_array_equal(terms, expected_terms)
    np.testing.assert_array_equal(grad[inner], expected_grad)
    grad[inner] = 0
    assert not grad.any()
    with pytest.raises(ValueError, match="reaches outside"):
        run(loss, padded, target, (4, 0))


def test_equal_images_have_no_loss_and_no_gradient(dev, rng, weights):
    loss = PerceptualLoss(dev, WEIGHT, make_policy(dev), weights)
    for target in (images(rng, 20, 30)[1], np.ones((20, 30, 3), np.float32)):
        terms, grad = run(loss, target, target)
        assert not terms.any() and not grad.any()


@pytest.mark.large
def test_sizes_may_change_between_calls_and_bits_stay(dev, rng, weights):
    loss, seen = PerceptualLoss(dev, WEIGHT, make_policy(dev), weights), {}
    pairs = [images(rng, *size) for size in [(20, 40), (33, 17)]]
    for i in (0, 1, 0, 1):
        terms, grad = run(loss, *pairs[i])
        bits = terms.tobytes() + grad.tobytes()
        assert seen.setdefault(i, bits) == bits


@pytest.mark.parametrize("macros", [{"LANES": 16}, {"LANES": 1, "GROUP": 64}], ids=str)
@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_sums_equal_float64(dev, rng, n, macros):
    """A block of n x 31 pixels behind the 5 rows of others, and one of 31 x n; in both forms."""
    program, group = dev.program("training/perceptual", **macros), macros.get("GROUP", 1)
    for h, w in ((n, 31), (31, n)):
        distance = rng.uniform(0, 1, (h, w)).astype(np.float32)
        row_term, total = dev.upload(np.ones(5 + h), np.float32), dev.empty((1,))
        terms = dev.upload(np.ones(4), np.float32)
        program.launch(
            "perceptual_rows",
            h * group,
            64,
            h=h,
            w=w,
            first=5,
            distance=dev.upload(distance),
            row_term=row_term,
        )
        program.launch(
            "perceptual_sum",
            64,
            64,
            n=5 + h,
            weight=0.5,
            row_term=row_term,
            distance=total,
            terms=terms,
        )
        expected = distance.mean(axis=1, dtype=np.float64) / h
        assert relative_error(row_term.get()[5:], expected) < 1e-6
        assert total.get()[0] == pytest.approx(5 + expected.sum(), rel=1e-6)
        np.testing.assert_allclose(terms.get(), [3.5 + 0.5 * expected.sum(), 1, 1, 1], rtol=1e-6)


@pytest.mark.large
def test_tables_are_what_it_takes(dev, rng, weights):
    before, policy, size = dev.bytes, make_policy(dev), (64, 40)
    loss = PerceptualLoss(dev, WEIGHT, policy, weights)
    run(loss, *images(rng, *size))
    tables = [PerceptualLoss.table((*size, 3), WIDTHS), Lpips.table(dev, policy, size, WIDTHS)]
    assert dev.bytes - before == sum(map(table_bytes, tables))


def test_weight_0_takes_nothing_and_adds_nothing(dev, rng, monkeypatch):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", _no_weights)
    before, programs = dev.bytes, len(dev._programs)
    loss = PerceptualLoss(dev, 0.0, make_policy(dev))
    terms, grad = run(loss, *images(rng, 8, 8))
    assert not terms.any() and not grad.any() and loss.terms() == {}
    assert (dev.bytes, len(dev._programs)) == (before, programs)


def _no_weights():
    raise UserError("LPIPS weights: no network")


# ---- trainings


def rows(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


@pytest.mark.large
def test_a_training_without_it_reads_no_weights(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", _no_weights)
    assert main(arguments(scene, tmp_path / "off")) == 0
    assert all("lpips" not in row for row in rows(tmp_path / "off"))


@pytest.mark.large
def test_a_training_with_it_lowers_it(scene, tmp_path, monkeypatch, weights):
    """The loss holds it and falls, and it ends lower than where it is only measured."""
    monkeypatch.setattr("pp_cl.metrics.lpips.load_weights", lambda: weights)
    ends, slowly = {}, {"network__blocks": "double", "network__residual": "false"}
    slowly |= {"train__mask_weight": 0, "train__smooth_l1": 0, "train__spread_weight": 0}
    slowly["raster__radius"] = 0.75
    for weight in (1e-9, 0.1):
        out = tmp_path / str(weight)
        assert main(arguments(scene, out, **slowly, train__perceptual_weight=weight)) == 0
        log = [row for row in rows(out) if "loss" in row]
        for row in log:
            parts = row["l1"] + 0.2 * (1 - row["ssim"]) + weight * row["lpips"]
            assert row["loss"] == pytest.approx(parts, rel=1e-5)
        assert np.mean([row["loss"] for row in log[-3:]]) < 0.8 * log[0]["loss"]
        ends[weight] = np.mean([row["lpips"] for row in log[-3:]])
    assert ends[0.1] < 0.8 * ends[1e-9]


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
