import numpy as np
import pytest

from pp_cl.metrics import lpips
from pp_cl.metrics.psnr_ssim import PSNR_CAP, Metrics, psnr, ssim
from pp_cl.reference.loss import ssim as reference
from pp_cl.reference.lpips import random_weights


@pytest.fixture
def pair(rng):
    a = rng.integers(0, 256, (19, 23, 3))
    return a.astype(np.uint8), np.clip(a + rng.integers(-60, 60, a.shape), 0, 255).astype(np.uint8)


def test_psnr_of_known_errors(pair):
    a, b = pair
    black = np.zeros((4, 5, 3), np.uint8)
    assert psnr(black, black + 1) == pytest.approx(20 * np.log10(255))
    assert psnr(black, black + 255) == pytest.approx(0, abs=1e-12)
    assert (
        psnr(a, b) == psnr(b, a) == pytest.approx(-10 * np.log10(np.mean((a / 255 - b / 255) ** 2)))
    )


def test_psnr_is_capped_so_that_it_stays_a_number():
    a = np.zeros((1000, 1000, 3), np.uint8)
    assert psnr(a, a) == PSNR_CAP
    b = a.copy()
    b[0, 0, 0] = 1  # a PSNR of 113 dB without the cap
    assert psnr(a, b) == PSNR_CAP


def test_ssim_is_that_of_the_loss(pair):
    a, b = pair
    assert ssim(a, b) == pytest.approx(reference(a / 255, b / 255)[0], abs=1e-12)
    assert ssim(a, a) == 1


def test_images_are_rounded_to_8_bits_first(pair):
    measure = Metrics(None, ("psnr", "ssim"))
    a, b = pair
    expected = {"psnr": psnr(a, b), "ssim": ssim(a, b)}
    assert measure(a / 255, b / 255) == expected
    assert measure(np.float32(a / 255 + 0.49 / 255), np.float32(b / 255 - 0.49 / 255)) == expected
    assert measure(np.where(a == 255, 7.0, a / 255), np.where(b == 0, -3.0, b / 255)) == expected


def test_nan_and_other_shapes_are_refused():
    measure = Metrics(None, ("psnr",))
    image = np.zeros((12, 12, 3))
    with pytest.raises(ValueError, match="NaN"):
        measure(np.full_like(image, np.nan), image)
    with pytest.raises(ValueError, match="truth"):
        measure(image, image[1:])


def test_only_the_named_metrics_are_computed_in_their_order(dev, rng, pair, monkeypatch):
    weights = random_weights(rng)
    monkeypatch.setattr(lpips, "load_weights", lambda: weights)
    a, b = (image / 255 for image in pair)
    measured = Metrics(dev, ("lpips", "psnr"))(a, b)
    assert list(measured) == ["lpips", "psnr"]
    assert measured["lpips"] == lpips.Lpips(dev, weights).distance(a, b) > 0
    assert list(Metrics(None, ("ssim",))(a, b)) == ["ssim"]
