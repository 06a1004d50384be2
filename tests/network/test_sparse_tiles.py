"""pp_cl/network/sparse_tiles.py: the same network with fewer tiles, against the one that computes
all and against float64.
"""

import numpy as np
import pytest
from oracle.unet import unet, unet_gradients
from support.comparisons import relative_error
from support.networks import plain_parameters

import pp_cl.network.unet
from pp_cl.config import preset
from pp_cl.layers.choice import make_policy
from pp_cl.layers.tiles import SIDE, grid_shape, tiles_find
from pp_cl.model import Model
from pp_cl.network.layers import BLOCKS, convolutions, unet_layers
from pp_cl.network.tile_plan import (
    LOSS_BORDER,
    ForwardPlan,
    double,
    gradient_radius,
    grow,
    halve,
    map_tiles,
    receptive_radius,
)
from pp_cl.network.unet import UNet
from pp_cl.raster.blend import BACKGROUND
from pp_cl.render import Renderer
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.load import load_scene

LAYERS = unet_layers((16, 16, 16))
GRADIENT = np.float32([0.3, -0.2, 0.1])
SIZE = (148, 180)  # room for a class inside; levels 1 and 2 end in tiles that are cut off
OBJECTS = {  # (rows, columns) that are not background
    "inside": (slice(60, 81), slice(70, 93)),
    "across the border": (slice(100, 148), slice(0, 30)),
    "one corner pixel": (slice(147, 148), slice(179, 180)),
    "along a border": (slice(0, 4), slice(0, 180)),
    "nothing": (slice(0, 0), slice(0, 0)),
    "everywhere": (slice(0, 148), slice(0, 180)),
}


@pytest.fixture
def always(monkeypatch):
    """Choose tiles in small images, too, and however many remain."""
    monkeypatch.setattr(pp_cl.network.unet, "LEAST_PIXELS", 0)
    monkeypatch.setattr(pp_cl.network.unet, "MOST_COMPUTED", 1)


def scene(rng, place, size=SIZE):
    """(features, gradient of the image): background and one colour, but for `place` and, in the
    gradient, another one.
    """
    x, grad_y = (
        np.full((*size, 16), BACKGROUND, np.float32),
        np.full((*size, 3), GRADIENT, np.float32),
    )
    x[place] = rng.normal(size=x[place].shape)
    grad_y[place] = rng.normal(size=grad_y[place].shape)
    grad_y[10:30, 120:150] = rng.normal(size=(20, 30, 3))
    return x, grad_y


def active_tiles(x):
    """(rows, columns) bool: the tiles of (H, W, C) that are not all background."""
    return tiles_where((x != BACKGROUND).any(2))


def tiles_where(pixels):
    """(rows, columns) bool: the tiles that hold any of the pixels (H, W) bool."""
    return halve(pixels, 2)


def run(dev, net, x, grad_y, background):
    """[image, gradient of x, gradients of the parameters] as the device computes them."""
    plan = None
    if background is not None:
        differs = tiles_where((grad_y != GRADIENT).any(2))
        plan = net.plan_tiles(x.shape[:2], active_tiles(x), differs)
    x = dev.upload(x)
    y = net.forward(x, True, plan).get()
    return [y, net.backward(dev.upload(grad_y)).get(), *[g.get() for g in net.gradients.values()]]


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize(
    "variant, blocks",
    [("direct", "double"), ("auto", "double"), ("direct", "single"), ("direct", "gated")],
)
def test_the_shown_tiles_are_the_dense_networks(dev, rng, name, variant, blocks):
    """Its buffers are full of NaN at first and none comes to what is shown; two images of the same
    features have the same bits, whatever was made between them.
    """
    x = rng.normal(size=(*SIZE, 16)).astype(np.float32)
    features = np.full_like(x, BACKGROUND)
    features[OBJECTS[name]] = x[OBJECTS[name]]
    policy = make_policy(dev, variant=variant)
    net = UNet(dev, (16, 32, 48), blocks=blocks, seed=1, policy=policy)
    device_x = dev.upload(features)
    plan = net.plan_shown(SIZE, active_tiles(features))
    first = net.forward(device_x, False, plan).get()
    other = dev.upload(x)
    dense_of_other = net.forward(other, False).get()
    dense = net.forward(device_x, False).get()
    shown = plan.shown.repeat(SIDE, 0).repeat(SIDE, 1)[: SIZE[0], : SIZE[1]]
    found = (features != BACKGROUND).any(2)
    assert not (found & ~shown).any() and np.isfinite(dense_of_other).all()
    if not shown.any():
        return
    assert relative_error(first[shown], dense[shown]) < 2e-6
    plan = net.plan_shown(SIZE, active_tiles(features))
    again = net.forward(device_x, False, plan).get()
    assert np.array_equal(again[shown], first[shown])


def test_what_is_not_shown_is_not_computed(dev, rng):
    net = UNet(dev, (16, 32, 48), seed=1)
    features = np.full((*SIZE, 16), BACKGROUND, np.float32)
    features[60:81, 70:93] = 0
    plan = net.plan_shown(SIZE, active_tiles(features))
    forward = ForwardPlan(dev, net.layers, SIZE, active_tiles(features))
    assert plan.computed_fraction < 0.6 * forward.computed_fraction
    last = net.layers[-1].name
    assert plan.maps[last].computed.sum() == plan.shown.sum() + 1  # and one for all others


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize(
    "variant, blocks",
    [("direct", "double"), ("auto", "double"), ("direct", "single"), ("direct", "gated")],
)
@pytest.mark.exact
def test_equals_the_dense_network(dev, rng, always, name, variant, blocks):
    x, grad_y = scene(rng, OBJECTS[name])
    policy = make_policy(dev, variant=variant)
    net = UNet(dev, (16, 32, 48), blocks=blocks, seed=1, policy=policy)
    expected = run(dev, net, x, grad_y, None)
    actual = run(dev, net, x, grad_y, BACKGROUND)
    device_x = dev.upload(x)
    plan = net.plan_tiles(SIZE, active_tiles(x))
    assert (plan.computed_fraction < 0.4) == (name != "everywhere")
    np.testing.assert_array_equal(net.forward(device_x, False, plan).get(), actual[0])
    if variant == "direct":  # Winograd mixes the last bits of a tile
        np.testing.assert_array_equal(actual[0], expected[0])
    for a, b in zip(actual[:2], expected[:2], strict=True):
        assert np.abs(a - b).max() <= 1e-6 * np.abs(b).max()
    # sums over 26,640 pixels, added up in another order
    for a, b in zip(actual[2:], expected[2:], strict=True):
        assert relative_error(a, b) < 5e-6


@pytest.mark.parametrize(
    "name, blocks",
    [
        ("inside", "double"),
        ("across the border", "double"),
        ("inside", "single"),
        ("across the border", "gated"),
    ],
)
def test_equals_float64(dev, rng, always, name, blocks):
    x, grad_y = scene(rng, OBJECTS[name])
    net = UNet(dev, (16, 16, 32), blocks=blocks, seed=2)
    actual, parameters = run(dev, net, x, grad_y, BACKGROUND), plain_parameters(net, net.parameters)
    expected_x, expected = unet_gradients(x, parameters, grad_y, blocks)
    assert relative_error(actual[0], unet(x, parameters, blocks)[0]) < 3e-6
    assert relative_error(actual[1], expected_x) < 1e-5
    gradients = plain_parameters(net, net.gradients)
    errors = {key: relative_error(gradients[key], expected[key]) for key in expected}
    assert max(errors.values()) < 1e-5, errors


def test_nan_comes_through(dev, rng, always):
    x, grad_y = scene(rng, OBJECTS["inside"])
    x[70, 80, 3] = np.nan
    net = UNet(dev, (16, 16, 16))
    expected, actual = run(dev, net, x, grad_y, None), run(dev, net, x, grad_y, BACKGROUND)
    assert np.isnan(actual[0][70, 80]).all()
    assert np.isfinite(actual[0][5, 5]).all()
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b))


def test_few_tiles_in_large_images_only(dev, rng):
    net = UNet(dev, (16, 16, 16))
    for height, end, chosen in ((256, 60, True), (256, 240, False), (252, 60, False)):
        x = scene(rng, (slice(40, end), slice(40, end)), (height, 256))[0]
        plan = net.plan_tiles(x.shape[:2], active_tiles(x))
        assert (plan is not None) == chosen
        if chosen:
            assert plan.computed_fraction <= pp_cl.network.unet.MOST_COMPUTED


@pytest.mark.parametrize("blocks", BLOCKS)
def test_radius_is_what_a_change_reaches(rng, blocks):
    """In float64, for a change at every place of a period of the pooling and the border far
    away.
    """
    parameters = {}
    layers, size, centre = unet_layers((1, 1, 1), 1, 1, blocks), 96, 48
    for layer in convolutions(layers):
        parameters |= {
            f"{layer.name}.weight": rng.uniform(0.5, 1, layer.weight_shape()),
            f"{layer.name}.bias": np.ones(layer.channels),
        }
    before = unet(np.ones((size, size, 1)), parameters, blocks)[1]
    reached = dict.fromkeys(before, 0)
    grad = np.zeros((size, size, 1))
    reached_back = 0
    for place in range(centre, centre + 4):
        x = np.ones((size, size, 1))
        x[place, place] = 2
        after = unet(x, parameters, blocks)[1]
        for name, value in after.items():
            if name not in ("wide1", "wide0", "up1", "up0"):  # the oracle enlarges first
                scale = size // len(value)
                rows = np.flatnonzero(np.abs(value - before[name])[..., 0].max(1) > 1e-9)
                reached[name] = max(
                    reached[name], place - rows[0] * scale, rows[-1] * scale + scale - 1 - place
                )
        grad[:], grad[place, place] = 0, 1
        rows = np.flatnonzero(
            np.abs(unet_gradients(np.ones((size, size, 1)), parameters, grad, blocks)[0])[
                ..., 0
            ].max(1)
            > 1e-12
        )
        reached_back = max(reached_back, place - rows[0], rows[-1] - place)
    radius = receptive_radius(layers)
    for name in reached:
        if reached[name]:
            assert reached[name] <= radius[name] <= reached[name] + 3, name
    assert reached_back <= gradient_radius(layers)["x"] <= reached_back + 3


@pytest.mark.parametrize("n", [1, 2, 7, 60])
def test_grow_halve_and_double(rng, n):
    tiles = rng.random((31, 17)) < 0.01
    grown = grow(tiles, n)
    for r, c in np.ndindex(tiles.shape):
        assert grown[r, c] == tiles[max(r - n, 0) : r + n + 1, max(c - n, 0) : c + n + 1].any()
    half = halve(tiles)
    assert half.shape == (16, 9)
    assert all(
        half[r, c] == tiles[2 * r : 2 * r + 2, 2 * c : 2 * c + 2].any()
        for r, c in np.ndindex(half.shape)
    )
    np.testing.assert_array_equal(halve(tiles, 2), halve(half))
    np.testing.assert_array_equal(halve(double(half, tiles.shape)), half)
    assert double(half, tiles.shape).shape == tiles.shape


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("border", [0, 3, 100])
def test_map_tiles(rng, level, border):
    height, width = 148, 260
    shape = grid_shape(height >> level, width >> level)
    active = rng.random(shape) < 0.3
    found = map_tiles((height, width), level, active, border)
    tiles = np.arange(active.size).reshape(shape)
    assert found.computed.ravel()[found.source.ravel()].all()
    assert (found.source == tiles)[active].all()
    assert not active.ravel()[found.source[~active]].any()
    assert found.count().sum() == active.size
    assert (found.count()[active] == 1).all()
    np.testing.assert_array_equal(found.count() > 0, found.computed)
    side = SIDE << level
    for place, source in np.ndenumerate(found.source):
        for index, other, length in zip(
            place, divmod(source, shape[1]), (height, width), strict=True
        ):
            inner = [
                border * SIDE <= i * side and (i + 1) * side <= length - border * SIDE
                for i in (index, other)
            ]
            assert other == index or all(inner)


def test_the_loss_sees_the_border_no_further(dev):
    """The margin that is compared tile by tile holds what the forward pass and a window of the
    SSIM's gradient reach.
    """
    assert receptive_radius(LAYERS)["out"] + 2 * 5 <= LOSS_BORDER


def test_lego(dev, data, rng, always):
    views = load_scene(data / "nerf_synthetic/lego", ("train",)).splits["train"][:8]
    hull = build_grid(dev, views, 20_000)
    near_far = depth_range(views, hull)
    net = UNet(dev, widths=(16, 32, 48), seed=1)
    model = Model.create(dev, hull.grid, hull.ids, near_far, net=net)
    model.cloud.sh[0].set(rng.normal(size=model.cloud.sh[0].shape).astype(np.float32))
    renderer = Renderer(dev, model, preset("tiny").raster)
    for view in views[:2]:
        x = renderer.rasterise(view.reduced(2).camera, 0.01).features
        active = tiles_find(dev, x, BACKGROUND).get()
        maps = ForwardPlan(dev, model.net.layers, x.shape[:2], active).maps
        computed = np.mean([tile_map.computed.mean() for tile_map in maps.values()])
        grad_y = dev.upload(np.full((*x.shape[:2], 3), 0.1, np.float32))
        results = []
        for background in (None, BACKGROUND):
            plan = None
            if background is not None:
                same = np.zeros_like(active)
                plan = model.net.plan_tiles(x.shape[:2], active, same)
            y = model.net.forward(x, True, plan).get()
            results.append(
                (
                    y,
                    model.net.backward(grad_y).get(),
                    *[g.get() for g in model.net.gradients.values()],
                )
            )
        assert 0.1 < computed < 0.6
        assert np.abs(results[0][0] - results[1][0]).max() <= 1e-6 * np.abs(results[0][0]).max()
        assert np.linalg.norm(results[0][1] - results[1][1]) <= 1e-6 * np.linalg.norm(results[0][1])
        for a, b in zip(results[0][2:], results[1][2:], strict=True):
            assert relative_error(b, a) < 5e-6
