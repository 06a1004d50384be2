"""cl/layers/winograd_gemm.cl against float64, and against the direct kernel."""

import numpy as np
import pytest
from oracle.conv import conv, conv_gradients
from support.comparisons import relative_error
from support.conv_layers import check_hard_inputs, layer

from pp_cl.layers import winograd_gemm as module
from pp_cl.layers.blocking import SHIPPED
from pp_cl.layers.conv import conv_forward, pack_bias, pack_weights
from pp_cl.layers.tiles import some_tiles
from pp_cl.layers.winograd_gemm import (
    scratch_floats,
    tiles_at_a_time,
    transformed_floats,
    winograd_gemm_backward_input,
    winograd_gemm_forward,
    winograd_gemm_weights,
)
from pp_cl.layers.work import COUNTERS, Work

# (height, width, channels in, channels out): less than a tile, tails of tiles and of work-groups,
# each number of output channels that a work-group computes
SHAPES = [
    (1, 5, 16, 32),
    (5, 1, 32, 48),
    (1, 1, 16, 16),
    (31, 33, 16, 48),
    (257, 3, 32, 16),
    (6, 31, 48, 64),
    (8, 8, 512, 32),
    (16, 24, 32, 512),
]
# {m: error over the largest value}: the transforms of F(4x4) cost more than the sums do
BOUNDS = {2: 3e-6, 4: 8e-6}

pytestmark = pytest.mark.parametrize("m", BOUNDS)


def work_of(dev, m, weight, flipped=None):
    """Work memory with the transformed weights (CO, CI, 3, 3)."""
    co, ci = weight.shape[:2]
    ci, co = (co, len(flipped)) if flipped else (ci, co)
    work = Work.empty(dev, scratch_floats(dev, m, ci, co), transformed_floats(m, ci, co))
    winograd_gemm_weights(dev, m, dev.upload(pack_weights(weight)), work.weights, flipped=flipped)
    return work


def run_forward(dev, m, x, weight, bias, relu, x2=None, tiles=None):
    out = dev.empty((*x.shape[:2], len(bias)))
    sources = tuple(dev.upload(source) for source in (x, x2) if source is not None)
    bias, work = dev.upload(pack_bias(bias)), work_of(dev, m, weight)
    winograd_gemm_forward(dev, m, sources, bias, out=out, relu=relu, work=work, tiles=tiles)
    return out.get()


def run_backward_input(dev, m, x, weight, grad_out, masked, first=0):
    grad_x, mask = dev.empty(x.shape), dev.upload(x) if masked else None
    work = work_of(dev, m, weight, range(first, first + x.shape[2]))
    winograd_gemm_backward_input(dev, m, dev.upload(grad_out), grad_x, mask=mask, work=work)
    return grad_x.get()


def test_in_small_work_groups(dev, rng, monkeypatch, m):
    """What a simulator runs in half a minute: two sources, both directions, a tail of tiles."""
    monkeypatch.setattr(module, "GROUPS", (32,))
    x, x2 = (np.maximum(rng.normal(size=(1, 5, 16)), 0).astype(np.float32) for _ in range(2))
    both, grad_out = np.concatenate([x, x2], 2), rng.normal(size=(1, 5, 16)).astype(np.float32)
    weight, bias = layer(rng, 32, 16, 3)
    actual = run_forward(dev, m, x, weight, bias, True, x2)
    assert relative_error(actual, conv(both, weight, bias, True)) < BOUNDS[m]
    expected = conv_gradients(both, weight, grad_out)[0][..., 16:] * (x2 > 0)
    actual = run_backward_input(dev, m, x2, weight, grad_out, True, first=16)
    assert relative_error(actual, expected) < BOUNDS[m]


@pytest.mark.large
@pytest.mark.parametrize("shape", SHAPES)
def test_forward(dev, rng, shape, m):
    height, width, ci, co = shape
    x = rng.normal(size=(height, width, ci)).astype(np.float32)
    weight, bias = layer(rng, ci, co, 3)
    given = dev, m, x, weight, bias
    assert relative_error(run_forward(*given, True), conv(x, weight, bias, True)) < BOUNDS[m]
    expected = conv(x, weight, bias)
    error = relative_error(run_forward(*given, False), expected)
    assert error < BOUNDS[m]
    if m == 2:  # at most the direct kernel's, but for the last bit of a few roundings
        direct, sources = dev.empty(expected.shape), (dev.upload(x),)
        arrays = dev.upload(pack_weights(weight)), dev.upload(pack_bias(bias))
        conv_forward(dev, sources, *arrays, out=direct, relu=False, blocking=SHIPPED["CPU"])
        assert error < 1.2 * relative_error(direct.get(), expected) + 2**-23


@pytest.mark.large
@pytest.mark.parametrize("c1, c2", [(16, 32), (48, 16)])
def test_two_sources_are_a_concatenation(dev, rng, c1, c2, m):
    x = rng.normal(size=(7, 29, c1 + c2)).astype(np.float32)
    weight, bias = layer(rng, c1 + c2, 16, 3)
    first, second = (np.ascontiguousarray(s) for s in np.split(x, [c1], 2))
    actual = run_forward(dev, m, first, weight, bias, True, second)
    assert relative_error(actual, conv(x, weight, bias, True)) < BOUNDS[m]
    np.testing.assert_array_equal(actual, run_forward(dev, m, x, weight, bias, True))


@pytest.mark.large
@pytest.mark.parametrize("shape", SHAPES)
def test_backward_input(dev, rng, shape, m):
    height, width, ci, co = shape
    x = np.maximum(rng.normal(size=(height, width, ci)), 0).astype(np.float32)
    weight, _ = layer(rng, ci, co, 3)
    grad_out = rng.normal(size=(height, width, co)).astype(np.float32)
    expected = conv_gradients(x, weight, grad_out)[0]
    for masked, wanted in ((False, expected), (True, expected * (x > 0))):
        actual = run_backward_input(dev, m, x, weight, grad_out, masked)
        assert relative_error(actual, wanted) < BOUNDS[m]


@pytest.mark.large
def test_backward_input_of_the_second_source(dev, rng, m):
    x2 = rng.normal(size=(9, 14, 48)).astype(np.float32)
    weight, _ = layer(rng, 16 + 48, 32, 3)
    grad_out = rng.normal(size=(9, 14, 32)).astype(np.float32)
    both = np.concatenate([np.zeros((9, 14, 16)), x2], 2)
    expected = conv_gradients(both, weight, grad_out)[0][..., 16:]
    actual = run_backward_input(dev, m, x2, weight, grad_out, False, first=16)
    assert relative_error(actual, expected) < BOUNDS[m]


@pytest.mark.large
def test_hard_inputs(dev, rng, m):
    if m == 2:  # those of F(4x4) are bounded channel by channel (test_variants.py)
        check_hard_inputs(
            dev,
            rng,
            lambda dev, *given: run_forward(dev, m, *given),
            lambda dev, *given: run_backward_input(dev, m, *given),
        )


@pytest.mark.large
def test_same_bits_in_chunks_of_any_size(dev, rng, monkeypatch, m):
    """With all tiles and with some."""
    height, width = 70, 90
    x = rng.normal(size=(height, width, 16)).astype(np.float32)
    weight, bias = layer(rng, 16, 32, 3)
    expected = run_forward(dev, m, x, weight, bias, True)
    count = rng.random((18, 23)) < 0.8
    tiles = some_tiles(dev, (height, width), count)
    chosen = np.kron(count, np.ones((4, 4), bool))[:height, :width, None]
    monkeypatch.setattr(module, "LEAST_BYTES", 0)
    monkeypatch.setattr(module, "MOST_BYTES", 0)
    for items, chunk in ((128, 256), (32, 64)):  # a work-group's tiles, which even no cache holds
        monkeypatch.setattr(module, "GROUPS", (items,))
        assert tiles_at_a_time(dev, m, 16, 32) == chunk
        np.testing.assert_array_equal(run_forward(dev, m, x, weight, bias, True), expected)
        some = run_forward(dev, m, x, weight, bias, True, tiles=tiles)
        np.testing.assert_array_equal(some, np.where(chosen, expected, np.nan))


def test_the_chunk_is_half_of_the_last_cache(dev, monkeypatch, m):
    for cache, held in ((0, 2**23), (24 * 2**20, 12 * 2**20), (2**30, 2**25)):
        monkeypatch.setitem(dev.info, "cache_bytes", cache)
        for ci, co, group in ((64, 64, 128), (32, 96, 256), (512, 48, 512)):
            floats = (m + 2) ** 2 * (ci + co)
            number = tiles_at_a_time(dev, m, ci, co)
            assert number % group == 0 and number >= group
            assert number == group or number * floats * 4 <= held < (number + group) * floats * 4
            assert scratch_floats(dev, m, ci, co) == COUNTERS + number * floats


@pytest.mark.large
@pytest.mark.parametrize("most", [32, 64])
def test_smaller_work_groups_compute_the_same_bits(dev, rng, monkeypatch, most, m):
    x = rng.normal(size=(9, 30, 16)).astype(np.float32)
    weight, bias = layer(rng, 16, 16, 3)
    expected = run_forward(dev, m, x, weight, bias, True)
    tried = set()

    def runs(program, kernel, items):
        tried.add(items)
        return items <= most

    monkeypatch.setattr(module, "runs", runs)
    np.testing.assert_array_equal(run_forward(dev, m, x, weight, bias, True), expected)
    assert tried == {n for n in module.GROUPS if n >= most}


@pytest.mark.large
def test_relu_hides_no_nan(dev, rng, m):
    x = rng.normal(size=(9, 11, 16)).astype(np.float32)
    x[4, 5, 6] = np.nan
    weight, bias = layer(rng, 16, 16, 3)
    bad = np.isnan(run_forward(dev, m, x, weight, bias, True)).all(axis=2)
    assert bad[3:6, 4:7].all()  # and more of the tiles that saw it
    assert not bad[:, 10].any()


def test_wrong_shapes_are_refused(dev, m):
    x, out, bias = dev.zeros((4, 4, 16)), dev.zeros((4, 4, 32)), dev.zeros(32)
    weight = np.zeros((32, 16, 3, 3))
    work = work_of(dev, m, weight)

    def forward(*sources, bias=bias, out=out):
        winograd_gemm_forward(dev, m, sources, bias, out=out, relu=False, work=work)

    def backward(grad_out, work=work):
        winograd_gemm_backward_input(dev, m, grad_out, x, mask=None, work=work)

    def weights(**given):
        transformed = given.pop("transformed", work.weights)
        winograd_gemm_weights(dev, m, dev.upload(pack_weights(weight)), transformed, **given)

    for match, call in (
        ("3 to 32 channels", lambda: forward(dev.zeros((4, 4, 3)))),
        ("16 \\+ 20 to 32", lambda: forward(x, dev.zeros((4, 4, 20)))),
        ("bias", lambda: forward(x, bias=dev.zeros(16))),
        ("4, 5, 32", lambda: forward(x, out=dev.zeros((4, 5, 32)))),
        ("transformed weights of", lambda: forward(x, x)),
        ("scratch of 10 floats", lambda: backward(out, Work(dev.zeros(10), work.weights))),
        ("20 to 16 channels", lambda: backward(dev.zeros((4, 4, 20)))),
        ("transformed weights of 10", lambda: weights(transformed=dev.zeros(10))),
        ("range\\(16, 32\\) of 16", lambda: weights(flipped=range(16, 32))),
        ("32 to 8 channels", lambda: weights(flipped=range(8))),
    ):
        with pytest.raises(ValueError, match=match):
            call()
