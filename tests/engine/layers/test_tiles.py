import re

import numpy as np
import pytest
from support.comparisons import relative_error
from support.tiles import pixels_of, random_counts

from pp_cl.engine.device.device import kernel_folder
from pp_cl.engine.layers.conv_local import TILE_PARTS
from pp_cl.engine.layers.simple import (
    avgpool2_backward,
    avgpool2_forward,
    gate_backward,
    gate_forward,
    upsample2_backward,
    upsample2_forward,
)
from pp_cl.engine.layers.tiles import (
    MAP_TILE,
    VECTOR,
    all_tiles,
    some_tiles,
)
from pp_cl.reference import network


def test_lists_and_wrong_sizes(dev):
    tiles = some_tiles(dev, (9, 6), np.array([[0, 2], [1, 0], [0, 5]]))
    np.testing.assert_array_equal(tiles.list.get(), [9, 6, 3, 1, 2, 5])
    np.testing.assert_array_equal(tiles.count.get(), [[0, 2], [1, 0], [0, 5]])
    np.testing.assert_array_equal(all_tiles(dev, 9, 6).list.get(), [9, 6, 6, *range(6)])
    np.testing.assert_array_equal(all_tiles(dev, 9, 6).count.get(), np.ones((3, 2)))
    tiles.check((9, 6))
    with pytest.raises(ValueError, match="\\(9, 6\\).*\\(9, 7\\)"):
        tiles.check((9, 7))
    with pytest.raises(ValueError, match="no tile"):
        some_tiles(dev, (9, 6), np.zeros((3, 2)))


@pytest.mark.parametrize("height, width, channels", [(1, 1, 16), (5, 7, 20), (33, 6, 17)])
def test_layers_compute_the_chosen_tiles(dev, rng, height, width, channels):
    def normal(scale, channels):
        size = (scale * height, scale * width, channels)
        return rng.normal(size=size).astype(np.float32)

    low, high, other = normal(1, channels), normal(2, channels), normal(2, channels)
    both, nan = normal(1, 2 * channels), np.float32(np.nan)
    others = some_tiles(dev, (99, 99), np.ones((25, 25)))
    wide = {id(a): a.astype(np.float64) for a in (low, high, both)}
    pooled = network.pool_backward(wide[id(low)])
    for call, inputs, start, expected in (
        (avgpool2_forward, [high], nan * low, network.pool(wide[id(high)])),
        (avgpool2_backward, [high, low], other, (other + pooled) * (high > 0)),
        (upsample2_forward, [low], nan * high, network.upsample(wide[id(low)])),
        (upsample2_backward, [high], nan * low, network.upsample_backward(wide[id(high)])),
        (gate_forward, [both], nan * low, network.gate(wide[id(both)])),
        (
            gate_backward,
            [both, low],
            nan * both,
            network.gate_backward(wide[id(both)], wide[id(low)]),
        ),
    ):
        size = start.shape[:2]
        counts, result = random_counts(rng, *size), dev.upload(start)
        tiles, chosen = some_tiles(dev, size, counts), pixels_of(counts > 0, *size)
        call(dev, *[dev.upload(array) for array in inputs], result, tiles=tiles)
        np.testing.assert_array_equal(result.get()[~chosen], start[~chosen])
        assert relative_error(result.get()[chosen], expected[chosen]) < 2e-6, call.__name__
        with pytest.raises(ValueError, match="tile_count has shape"):
            call(dev, *[dev.upload(array) for array in inputs], result, tiles=others)


@pytest.mark.parametrize(
    "file, name, value",
    [
        ("layers/tiles.h", "MAP_TILE", MAP_TILE),
        ("common.h", "CHANNELS", VECTOR),
        ("layers/conv_local.cl", "ROWS", MAP_TILE // TILE_PARTS),
    ],
)
def test_host_and_kernels_agree(file, name, value):
    text = (kernel_folder() / file).read_text("utf-8")
    assert int(re.search(rf"^#define {name} (\d+)", text, re.M)[1]) == value
