from collections import Counter

import numpy as np
import pytest
from support.comparisons import relative_error

import pp_cl.engine.network.unet
from pp_cl.engine.network.layers import convolutions, gradient_of, unet_layers
from pp_cl.engine.network.tile_plan import (
    LOSS_BORDER,
    LOSS_RADIUS,
    gradient_radius,
    halve,
    receptive_radius,
)
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.training.loss import TAPS
from pp_cl.reference.network import network, network_gradients
from pp_cl.settings import BLOCKS

BACKGROUND = 1.0  # features of a pixel without fragments, as in cl/common.h
LAYERS = unet_layers((16, 16, 16))
GRADIENT = np.float32([0.3, -0.2, 0.1])
SIZE = (148, 180)  # room for a class inside; levels 1 and 2 end in tiles that are cut off
OBJECTS = {  # (rows, columns) of pixels that are not background
    "inside": (slice(60, 81), slice(70, 93)),
    "across the border": (slice(100, 148), slice(0, 30)),
    "one corner pixel": (slice(147, 148), slice(179, 180)),
    "along a border": (slice(0, 4), slice(0, 180)),
    "nothing": (slice(0, 0), slice(0, 0)),
    "everywhere": (slice(0, 148), slice(0, 180)),
}
# (object, variant, blocks)
CASES = [
    *((name, "direct", "double") for name in OBJECTS),
    *(("inside", "auto", blocks) for blocks in BLOCKS),
    *(("across the border", "direct", blocks) for blocks in BLOCKS[1:]),
    ("one corner pixel", "auto", "double"),
]


@pytest.fixture
def always(monkeypatch):
    monkeypatch.setattr(pp_cl.engine.network.unet, "LEAST_PIXELS", 0)
    monkeypatch.setattr(pp_cl.engine.network.unet, "MOST_COMPUTED", 1)


def scene(rng, place, size=SIZE):
    """(features, gradient of the image): background and one colour, but random at `place` and, in
    the gradient, at another place.
    """
    x = np.full((*size, 16), BACKGROUND, np.float32)
    grad_y = np.full((*size, 3), GRADIENT, np.float32)
    x[place] = rng.normal(size=x[place].shape)
    grad_y[place] = rng.normal(size=grad_y[place].shape)
    grad_y[10:30, 120:150] = rng.normal(size=(20, 30, 3))
    return x, grad_y


def active_mask(x):
    """(rows, columns) bool: the tiles of (H, W, C) that are not all background."""
    return halve((x != BACKGROUND).any(2), 2)


def run(dev, net, x, grad_y, *, sparse):
    other = halve((grad_y != GRADIENT).any(2), 2)
    plan = net.plan_tiles(x.shape[:2], active_mask(x), other) if sparse else None
    x = dev.upload(x)
    y = net.forward(x, True, plan).get()
    grad_x, parts = net.backward(dev.upload(grad_y))
    return [y, grad_x.get(), *[g.get() for g in net.sum_gradients(parts).values()]]


@pytest.mark.parametrize("name, variant, blocks", CASES)
@pytest.mark.exact
def test_equals_the_dense_network(dev, rng, always, name, variant, blocks):
    x, grad_y = scene(rng, OBJECTS[name])
    net = UNet(dev, (16, 32, 48), blocks=blocks, seed=1, variant=variant)
    expected = run(dev, net, x, grad_y, sparse=False)
    actual = run(dev, net, x, grad_y, sparse=True)
    device_x = dev.upload(x)
    plan = net.plan_tiles(SIZE, active_mask(x))
    assert (plan.computed_fraction < 0.4) == (name != "everywhere")
    np.testing.assert_array_equal(net.forward(device_x, False, plan).get(), actual[0])
    if variant == "direct":  # Winograd rounds the pixels of a tile together
        np.testing.assert_array_equal(actual[0], expected[0])
    # so its results differ after seven layers, on Intel's runtime by up to 1.1e-6
    for a, b in zip(actual[:2], expected[:2], strict=True):
        assert np.abs(a - b).max() <= 2e-6 * np.abs(b).max()
    # sums over 26,640 pixels are added up in another order
    for a, b in zip(actual[2:], expected[2:], strict=True):
        assert relative_error(a, b) < 5e-6


def test_nan_comes_through(dev, rng, always):
    x, grad_y = scene(rng, OBJECTS["inside"])
    x[70, 80, 3] = np.nan
    net = UNet(dev, (16, 16, 16))
    expected, actual = (run(dev, net, x, grad_y, sparse=sparse) for sparse in (False, True))
    assert np.isnan(actual[0][70, 80]).all()
    assert np.isfinite(actual[0][5, 5]).all()
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b))


def test_few_tiles_in_large_images_only(dev, rng):
    net = UNet(dev, (16, 16, 16))
    for height, end, chosen in ((256, 60, True), (256, 240, False), (252, 60, False)):
        x = scene(rng, (slice(40, end), slice(40, end)), (height, 256))[0]
        plan = net.plan_tiles(x.shape[:2], active_mask(x))
        assert (plan is not None) == chosen
        if chosen:
            assert plan.computed_fraction <= pp_cl.engine.network.unet.MOST_COMPUTED
    net.freeze()  # a frozen network plans the last size, too small before, but not half of it
    assert net.plan_tiles(x.shape[:2], active_mask(x)) and not net.is_planned((124, 256))


@pytest.mark.parametrize("blocks", BLOCKS)
def test_radius_is_what_a_change_reaches(rng, blocks):
    layers, ones = unet_layers((1, 1, 1), 1, 1, blocks), np.ones((96, 96, 1))
    parameters = {}
    for layer in convolutions(layers):
        parameters[f"{layer.name}.weight"] = rng.uniform(0.5, 1, layer.weight_shape())
        parameters[f"{layer.name}.bias"] = np.ones(layer.channels)
    before, reached = network(layers, parameters, ones), Counter()
    active = {name: values > 0 for name, values in before.items()}

    def reach(name, change, place):
        scale = 96 // len(change)
        rows = scale * np.flatnonzero(np.abs(change[..., 0]).max(1) > 1e-9)
        far = max([place - rows[0], rows[-1] + scale - 1 - place] if len(rows) else [0])
        reached[name] = max(reached[name], far)

    for place in range(48, 52):
        impulse = np.zeros_like(ones)
        impulse[place, place] = 1
        for name, value in network(layers, parameters, ones + impulse).items():
            reach(name, value - before[name], place)
        gradients = network_gradients(layers, parameters, before, active, grad_image=impulse)
        reach(gradient_of("x"), gradients["x"], place)
    radius = receptive_radius(layers) | gradient_radius(layers)
    radius["image"] = radius["out"]
    for name, far in reached.items():
        assert far <= radius[name] <= far + 3, name


def test_the_backward_pass_starts_where_the_loss_sees_a_change(dev, always):
    net, active = UNet(dev, (16, 16, 16)), np.zeros((37, 45), bool)
    active[18, 22] = True
    plan = net.plan_tiles(SIZE, active, gradient_tiles=np.zeros_like(active))
    away = np.abs(np.argwhere(~plan.active) - (18, 22)).max(1)  # of the tiles that are left out
    assert 4 * (away.min() - 1) >= receptive_radius(net.layers)["out"] + LOSS_RADIUS


def test_the_loss_sees_the_border_no_further():
    """The margin that is compared tile by tile covers the reach of the forward pass and of the
    SSIM's gradient.
    """
    assert LOSS_RADIUS == 2 * (TAPS // 2)
    assert receptive_radius(LAYERS)["out"] + LOSS_RADIUS <= LOSS_BORDER
