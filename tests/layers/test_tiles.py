"""cl/layers/tiles.cl against numpy, and the kernels that compute some tiles only."""

import re

import numpy as np
import pytest
from oracle.conv import conv_gradients
from oracle.layers import avgpool2, avgpool2_gradient, upsample2, upsample2_gradient
from support.comparisons import relative_error
from support.conv_layers import layer
from support.guarded import large

from pp_cl.device.device import kernel_folder
from pp_cl.layers import resample as layers
from pp_cl.layers.choice import SHIPPED, VARIANTS
from pp_cl.layers.conv import Direction, Work, pack_bias, pack_weights, unpack_weights
from pp_cl.layers.conv_local import TILE_PARTS
from pp_cl.layers.tiles import (
    LANES,
    SIDE,
    all_tiles,
    all_tiles_buffers,
    checked_tiles,
    copy_list,
    grid_shape,
    some_tiles,
    tiles_copy,
    tiles_find,
    tiles_hit,
)
from pp_cl.network.tile_plan import grow

# (height, width, channels): less than a tile, cut-off tiles, several work-groups
SHAPES = [(1, 1, 1), (3, 5, 16), (31, 33, 3), (4, 257, 20), (257, 8, 16)]


def pixels_of(tiles, height, width):
    """(height, width) of what (rows, columns) says of the tiles."""
    return tiles.repeat(SIDE, 0).repeat(SIDE, 1)[:height, :width]


def by_tile(image):
    """{(row, column): pixels} of an image's tiles."""
    rows, columns = grid_shape(*image.shape[:2])
    return {
        (r, c): image[r * SIDE : (r + 1) * SIDE, c * SIDE : (c + 1) * SIDE]
        for r in range(rows)
        for c in range(columns)
    }


def random_counts(rng, height, width):
    """(rows, columns) of 0 (half of them), 1 and 7; at least one is not 0."""
    counts = rng.choice([0, 0, 1, 7], grid_shape(height, width))
    counts[-1, -1] = 7
    return counts


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.exact
def test_find(dev, rng, shape):
    x = np.where(
        rng.random(shape) < 0.02, rng.choice([0.0, np.nan, np.inf, 1 + 2**-23], shape), 1
    ).astype(np.float32)
    found = tiles_find(dev, dev.upload(x), 1.0).get()
    assert found.shape == grid_shape(*shape[:2])
    for place, tile in by_tile(x).items():
        assert found[place] == (tile != 1).any()


@pytest.mark.parametrize("height, width", [shape[:2] for shape in SHAPES])
@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_hit(dev, rng, height, width, share):
    hits = rng.integers(1, 5, (height, width)) * (rng.random((height, width)) < share)
    offsets = np.concatenate([[0], np.cumsum(hits)]).astype(np.uint32)
    found = tiles_hit(dev, dev.upload(offsets), (height, width)).get()
    assert found.shape == grid_shape(height, width)
    for place, tile in by_tile(hits).items():
        assert found[place] == tile.any()


@pytest.mark.parametrize("shape", SHAPES)
def test_copy(dev, rng, shape):
    x = rng.normal(size=shape).astype(np.float32)
    expected = x.copy()
    tiles, copies = by_tile(x), by_tile(expected)
    places = list(tiles)
    source, chosen = np.zeros(grid_shape(*shape[:2]), int), rng.random(grid_shape(*shape[:2])) < 0.5
    for place, tile in tiles.items():
        source[place] = places.index(place)
        like = [p for p in places if tiles[p].shape == tile.shape and not chosen[p]]
        chosen[place] &= bool(like)
        if chosen[place]:
            other = like[rng.integers(len(like))]
            source[place] = places.index(other)
            copies[place][:] = tiles[other]
    device_x = dev.upload(x)
    copies = copy_list(source, chosen)
    more = np.full((len(copies) + 3, 2), 2**30, np.int32)
    more[: len(copies)] = copies
    tiles_copy(dev, device_x, dev.upload(more), len(copies))
    np.testing.assert_array_equal(device_x.get(), expected)


def test_lists_and_wrong_sizes(dev):
    tiles = some_tiles(dev, (9, 6), np.array([[0, 2], [1, 0], [0, 5]]))
    np.testing.assert_array_equal(tiles.list.get(), [9, 6, 3, 1, 2, 5])
    np.testing.assert_array_equal(tiles.count.get(), [[0, 2], [1, 0], [0, 5]])
    assert checked_tiles(dev, tiles, 9, 6) is tiles
    whole = all_tiles(dev, 9, 6)
    assert whole.number == 6
    for name, (shape, dtype) in all_tiles_buffers(9, 6).items():
        assert getattr(whole, name).shape == shape and getattr(whole, name).dtype == dtype
    np.testing.assert_array_equal(checked_tiles(dev, None, 9, 6).list.get(), whole.list.get())
    with pytest.raises(ValueError, match="\\(9, 6\\).*\\(9, 7\\)"):
        checked_tiles(dev, tiles, 9, 7)
    with pytest.raises(ValueError, match="no tile"):
        some_tiles(dev, (9, 6), np.zeros((3, 2)))


@pytest.mark.parametrize(
    "k, variant",
    [
        (1, "direct"),
        (1, "local"),
        *[large(3, name) if name.endswith("_gemm") else (3, name) for name in VARIANTS],
    ],
)
@pytest.mark.parametrize("height, width", [(3, 2), (11, 14), large(31, 33), large(6, 70)])
def test_convolutions_compute_the_chosen_tiles(dev, rng, k, variant, height, width):
    """The other tiles of the results keep their NaN; those of a gradient that do not count may hold
    NaN, and so may inputs that no counted tile's gradient sees.
    """
    c1, c2, co = 16, 32, 48
    weight, bias = layer(rng, c1 + c2, co, k)
    x = np.maximum(rng.normal(size=(height, width, c1 + c2)), 0).astype(np.float32)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    counts = random_counts(rng, height, width)
    chosen = pixels_of(counts > 0, height, width)
    tiles = some_tiles(dev, (height, width), counts)
    sources = tuple(dev.upload(np.ascontiguousarray(s)) for s in np.split(x, [c1], 2))
    device_weight, device_grad = dev.upload(pack_weights(weight)), dev.upload(grad_out)

    convolution = VARIANTS[variant].convolution(dev, SHIPPED["CPU"])

    def work(direction, c):
        floats = convolution.work_floats(direction, height, device_weight.shape, c)
        return Work.empty(dev, *floats)

    bias = dev.upload(pack_bias(bias))
    whole, out = dev.empty((height, width, co)), dev.empty((height, width, co))
    for result, which in ((whole, None), (out, tiles)):
        convolution.forward(
            sources,
            device_weight,
            bias,
            result,
            relu=True,
            work=work(Direction.FORWARD, c1 + c2),
            tiles=which,
        )
    np.testing.assert_array_equal(out.get(), np.where(chosen[..., None], whole.get(), np.nan))

    whole, grad_x = dev.empty((height, width, c2)), dev.empty((height, width, c2))
    for result, which in ((whole, None), (grad_x, tiles)):
        convolution.backward_input(
            device_weight,
            c1,
            device_grad,
            result,
            mask=sources[1],
            work=work(Direction.BACKWARD_INPUT, c2),
            tiles=which,
        )
    np.testing.assert_array_equal(grad_x.get(), np.where(chosen[..., None], whole.get(), np.nan))

    grad_weight, grad_bias = dev.empty(device_weight.shape), dev.empty(co)
    poisoned = dev.upload(np.where(chosen[..., None], grad_out, np.nan), np.float32)
    seen = pixels_of(grow(counts > 0, k // 2), height, width)
    poisoned_x = np.where(seen[..., None], x, np.nan).astype(np.float32)
    poisoned_sources = np.split(poisoned_x, [c1], 2)
    convolution.backward_weights(
        tuple(dev.upload(np.ascontiguousarray(s)) for s in poisoned_sources),
        poisoned,
        grad_weight,
        grad_bias,
        work=work(Direction.BACKWARD_WEIGHTS, c1 + c2),
        tiles=tiles,
    )
    counted = grad_out * pixels_of(counts, height, width)[..., None]
    expected = conv_gradients(x, weight, counted.astype(np.float64))
    assert relative_error(unpack_weights(grad_weight.get(), co), expected[1]) < 1e-5
    assert relative_error(grad_bias.get(), expected[2]) < 1e-5


@pytest.mark.parametrize("height, width, channels", [(1, 1, 16), (5, 7, 20), (33, 6, 16)])
def test_layers_compute_the_chosen_tiles(dev, rng, height, width, channels):
    low, high = (
        rng.normal(size=(f * height, f * width, channels)).astype(np.float32) for f in (1, 2)
    )
    other = rng.normal(size=high.shape).astype(np.float32)

    def check(call, shape, expected, *inputs, start=None):
        counts = random_counts(rng, *shape[:2])
        result = dev.empty(shape) if start is None else dev.upload(start)
        tiles = some_tiles(dev, shape[:2], counts)
        call(dev, *[dev.upload(i) for i in inputs], result, tiles=tiles)
        chosen, untouched = (
            pixels_of(counts > 0, *shape[:2]),
            np.full(shape, np.nan) if start is None else start,
        )
        np.testing.assert_array_equal(result.get()[~chosen], untouched[~chosen])
        assert relative_error(result.get()[chosen], expected[chosen]) < 2e-6

    check(layers.avgpool2_forward, low.shape, avgpool2(high), high)
    check(layers.upsample2_forward, high.shape, upsample2(low), low)
    check(layers.upsample2_backward, low.shape, upsample2_gradient(high), high)
    check(
        layers.avgpool2_backward,
        high.shape,
        (other + avgpool2_gradient(low)) * (high > 0),
        high,
        low,
        start=other,
    )


@pytest.mark.parametrize(
    "file, name, value",
    [
        ("layers/tiles.h", "SIDE", SIDE),
        ("common.h", "CHANNELS", LANES),
        ("layers/conv_local.cl", "ROWS", SIDE // TILE_PARTS),
    ],
)
def test_host_and_kernels_agree(file, name, value):
    text = (kernel_folder() / file).read_text("utf-8")
    assert int(re.search(rf"^#define {name} (\d+)", text, re.M)[1]) == value
