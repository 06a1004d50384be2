"""LPIPS: kernels and network against the float64 twin, and published values."""

import numpy as np
import pytest
from oracle.lpips import lpips, pixel_distance, random_weights, scaled_input
from PIL import Image
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.errors import UserError
from pp_cl.metrics import lpips_weights
from pp_cl.metrics.lpips import Lpips


@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_input_equals_oracle(dev, rng, n):
    image = rng.uniform(0, 1, (n, 3)).astype(np.float32)
    x = dev.empty((n, 3))
    dev.program("metrics/lpips").launch("lpips_input", n, n=n, image=dev.upload(image), x=x)
    assert relative_error(x.get(), scaled_input(image.astype(np.float64))) < 1e-6


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("channels", [16, 64, 512])
def test_distance_equals_oracle(dev, rng, n, channels):
    a, b = (
        np.maximum(rng.normal(0, 1, (n, channels)), 0) * 10 ** rng.uniform(-3, 3, (n, 1))
        for _ in range(2)
    )
    a[0] = 0  # a pixel without features has no direction
    a, b, head = (
        a.astype(np.float32),
        b.astype(np.float32),
        rng.uniform(0, 1, channels).astype(np.float32),
    )
    distance = dev.empty((n,))
    dev.program("metrics/lpips").launch(
        "lpips_distance",
        n,
        n=n,
        c=channels,
        a=dev.upload(a),
        b=dev.upload(b),
        head=dev.upload(head),
        distance=distance,
    )
    expected = pixel_distance(a.astype(np.float64), b.astype(np.float64), head.astype(np.float64))
    assert relative_error(distance.get(), expected) < 2e-6


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (39, 31)])
def test_network_equals_oracle(dev, rng, size):
    weights = random_weights(rng)
    a = rng.uniform(0, 1, (*size, 3))
    b = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)
    expected = lpips(a, b, weights)
    assert expected > 0.01
    assert Lpips(dev, weights).distance(a, b) == pytest.approx(expected, rel=1e-5)


@pytest.mark.large
def test_same_images_are_at_distance_zero_and_runs_agree_bit_for_bit(dev, rng):
    network = Lpips(dev, random_weights(rng))
    a, b = rng.uniform(0, 1, (2, 35, 50, 3))
    assert network.distance(a, a) == 0
    assert network.distance(a, b) == network.distance(a, b) == network.distance(b, a) > 0


def test_images_that_are_too_small_or_differ_in_size_are_refused(dev, rng):
    network = Lpips(dev, random_weights(rng))
    with pytest.raises(UserError, match="40x15 pixels, LPIPS needs 16x16"):
        network.distance(np.zeros((15, 40, 3)), np.zeros((15, 40, 3)))
    with pytest.raises(ValueError, match="32"):
        network.distance(np.zeros((32, 32, 3)), np.zeros((32, 33, 3)))


@pytest.fixture(scope="module")
def weights():
    """The published weights; skips with the reason where they cannot be had."""
    try:
        return lpips_weights.load_weights()
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("name", "published"), [("ex_p0", 0.568613), ("ex_p1", 0.421664)])
def test_published_distances(dev, data, weights, name, published):
    a, b = (
        np.array(Image.open(data / "lpips_example" / f"{n}.png").convert("RGB")) / 255
        for n in ("ex_ref", name)
    )
    assert Lpips(dev, weights).distance(a, b) == pytest.approx(published, abs=1e-5)
