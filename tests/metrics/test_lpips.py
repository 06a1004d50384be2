"""LPIPS: both forms of its kernels, its memory, published values; the selftest has its numbers."""

import numpy as np
import pytest
from PIL import Image

from pp_cl.device.launch import group_ranges, row_parts
from pp_cl.errors import UserError
from pp_cl.metrics import lpips_weights
from pp_cl.metrics.lpips import Lpips, lpips_program
from pp_cl.reference.lpips import random_weights


def hard_features(rng, n, channels):
    """(a, b (n, channels), head (channels,)) float32: features of very different lengths."""
    a, b = (
        np.maximum(rng.normal(0, 1, (n, channels)), 0) * 10 ** rng.uniform(-3, 3, (n, 1))
        for _ in range(2)
    )
    a[0] = 0  # a pixel without features has no direction
    head = rng.uniform(0, 1, channels)
    return tuple(array.astype(np.float32) for array in (a, b, head))


def test_both_forms_have_the_same_bits(dev, rng, monkeypatch):
    a, b, head = (dev.upload(array) for array in hard_features(rng, 33, 64))
    found = []
    for is_cpu in (True, False):
        monkeypatch.setattr(dev, "is_cpu", is_cpu)
        distance, ranges = dev.empty((33,)), group_ranges(dev, 33, row_parts(dev))
        lpips_program(dev).launch(
            "lpips_distance", *ranges, n=33, c=64, a=a, b=b, head=head, distance=distance
        )
        found.append(distance.get().tobytes())
    assert found[0] == found[1]


@pytest.mark.large
def test_same_images_are_at_distance_zero_and_runs_agree_bit_for_bit(dev, rng):
    network = Lpips(dev, random_weights(rng))
    a, b = rng.uniform(0, 1, (2, 35, 50, 3))
    assert network.distance(a, a) == 0
    assert network.distance(a, b) == network.distance(a, b) == network.distance(b, a) > 0


def test_maps_keep_their_memory_from_pair_to_pair(dev, rng):
    """Pages of new maps would have to be mapped each time."""
    network = Lpips(dev, random_weights(rng))
    a, b = rng.uniform(0, 1, (2, 35, 50, 3)).astype(np.float32)
    network.distance(a, b)
    before = dev.reset_peak()
    network.distance(a, b)
    assert dev.peak_bytes <= before + a.nbytes + b.nbytes


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
