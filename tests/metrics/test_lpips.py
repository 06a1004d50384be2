"""Test LPIPS: refused sizes, memory, published values; the selftest compares its numbers."""

import numpy as np
import pytest
from PIL import Image

from pp_cl.errors import UserError
from pp_cl.metrics import lpips_weights
from pp_cl.metrics.lpips import Lpips
from pp_cl.reference.lpips import random_weights


@pytest.mark.large
def test_same_images_are_at_distance_zero_and_runs_agree_bit_for_bit(dev, rng):
    network = Lpips(dev, random_weights(rng))
    a, b = rng.uniform(0, 1, (2, 35, 50, 3))
    assert network.distance(a, a) == 0
    assert network.distance(a, b) == network.distance(a, b) == network.distance(b, a) > 0


def test_images_that_are_too_small_or_differ_in_size_are_refused(dev, rng):
    network = Lpips(dev, random_weights(rng))
    with pytest.raises(UserError, match="40x15 pixels, but LPIPS needs 16x16"):
        network.distance(np.zeros((15, 40, 3)), np.zeros((15, 40, 3)))
    with pytest.raises(ValueError, match="32"):
        network.distance(np.zeros((32, 32, 3)), np.zeros((32, 33, 3)))


@pytest.fixture(scope="module")
def weights():
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
