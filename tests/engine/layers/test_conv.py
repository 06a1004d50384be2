"""What the selftest does not compare with float64: some tiles, other launches, blockings, NaN."""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.guarded import large
from support.launches import check_parts
from support.tiles import pixels_of, random_counts

from pp_cl.bench.conv import Layer
from pp_cl.engine.layers import conv
from pp_cl.engine.layers.choice import CPUS, GPU, VARIANTS
from pp_cl.engine.layers.conv import ConvShape
from pp_cl.engine.layers.tiles import some_tiles
from pp_cl.engine.network.tile_plan import grow
from pp_cl.selftest.layers import within

CPU = CPUS[16]
DIRECT, LOCAL, WINOGRAD = "direct", "local", "winograd"
# (variant, side of the kernel)
ALL = [
    pytest.param(variant, k, id=f"{variant} {k}x{k}")
    for variant, k in ((DIRECT, 1), (DIRECT, 3), (LOCAL, 1), (LOCAL, 3), (WINOGRAD, 3))
]
OF_3X3 = [param for param in ALL if param.values[1] == 3]


@pytest.mark.parametrize("variant, k", ALL)
@pytest.mark.parametrize("size, co", [((6, 7), 16), large((31, 33), 48)])
def test_only_the_chosen_tiles(dev, rng, variant, k, size, co):
    """Chosen tiles have the bits of a run over all tiles; the others keep their NaN. The gradient
    of a tile that is not chosen may hold NaN, and so may inputs that no chosen tile reads.
    """
    layer = Layer.random(rng, size, (16, 16), co, k)
    counts = random_counts(rng, *size)
    tiles, count = some_tiles(dev, size, counts), pixels_of(counts, *size)[..., None]
    whole, chosen = layer.computed(dev, variant, CPU), layer.computed(dev, variant, CPU, tiles)
    for i in (0, 3, 4):  # the output and the gradients of the inputs
        np.testing.assert_array_equal(chosen[i], np.where(count > 0, whole[i], np.nan))
    is_read = pixels_of(grow(counts > 0, k // 2), *size)[..., None]
    parts = [np.where(is_read, part, np.float32(np.nan)) for part in layer.parts]
    poisoned = np.where(count > 0, layer.grad_out, np.float32(np.nan))
    weights = layer.weight, layer.bias
    actual = Layer(parts, *weights, poisoned).computed(dev, variant, CPU, tiles)
    expected = Layer(layer.parts, *weights, layer.grad_out * count).expected
    for i in (1, 2):  # the gradients of the weights and the bias
        assert relative_error(actual[i], expected[i]) < 1e-5


@pytest.mark.large
@pytest.mark.parametrize("variant, k", ALL[:4])
def test_launches_in_parts_compute_the_same_bits(dev, rng, monkeypatch, variant, k):
    layer = Layer.random(rng, (17, 30), (13,), 64, k)
    kernels = ["conv_forward", "conv_backward"]
    if variant == LOCAL:
        kernels = ["conv_local", "conv_local_backward_weights"]
    for kernel in kernels:
        launched = check_parts(
            dev, monkeypatch, kernel, lambda: tuple(layer.computed(dev, variant, GPU))
        )
        assert launched > 1, kernel


@pytest.mark.parametrize("size, channels", [large((131, 40), 48)])
def test_winograds_bits_do_not_depend_on_compute_units(dev, rng, monkeypatch, size, channels):
    layer = Layer.random(rng, size, (channels,), channels)
    expected = layer.computed(dev, WINOGRAD, CPU)
    for units in (1, 3, 100):
        monkeypatch.setitem(dev.info, "compute_units", units)
        for actual, same in zip(layer.computed(dev, WINOGRAD, CPU), expected, strict=True):
            np.testing.assert_array_equal(actual, same)


def test_smaller_work_groups_compute_the_same_bits(dev, rng, monkeypatch):
    layer = Layer.random(rng, (3, 9), (16,), 32)
    program = dev.program

    def limited(*args, **defines):
        compiled = program(*args, **defines)
        for kernel in compiled.kernels.values():
            patch.setattr(kernel, "largest_group", 48)
        return compiled

    # launched first, as a size is not checked again
    with monkeypatch.context() as patch:
        patch.setattr(dev, "program", limited)
        results = layer.computed(dev, LOCAL, CPU)
    for actual, same in zip(results, layer.computed(dev, LOCAL, CPU), strict=True):
        np.testing.assert_array_equal(actual, same)


@pytest.mark.large
@pytest.mark.parametrize("variant", [DIRECT, LOCAL])
@pytest.mark.parametrize("most", [20_000, 1])
def test_parts_grow_when_memory_is_short(dev, rng, monkeypatch, variant, most):
    layer = Layer.random(rng, (33, 10), (16, 20), 48)
    shape = ConvShape("backward", 3, (16, 20), 48, (33, 10))
    parts = VARIANTS[variant].parts_of(shape)
    monkeypatch.setattr(conv, "PARTIAL_FLOATS", most)
    assert VARIANTS[variant].parts_of(shape) < parts
    results = layer.computed(dev, variant, CPU)
    for i in (1, 2):
        assert relative_error(results[i], layer.expected[i]) < 5e-6


@pytest.mark.parametrize(
    "variant, blocking, shape",
    [
        pytest.param(variant, blocking, shape, id=f"{name} {shape}")
        for variant, shapes in (
            (DIRECT, [((13, 13), (32, 16), 32), ((7, 37), (16,), 48), ((3, 2), (3,), 20)]),
            (WINOGRAD, [((50, 45), (256,), 80), ((50, 31), (16,), 16), ((13, 13), (32, 16), 32)]),
        )
        for name, blocking in (("16 floats", CPUS[16]), ("8 floats", CPUS[8]), ("GPU", GPU))
        for shape in shapes
        if variant == DIRECT or blocking is not GPU
    ],
)
@pytest.mark.large
def test_every_row_of_the_table(dev, rng, variant, blocking, shape):
    """Images have more tiles than are computed at a time; memory is what each row asks for."""
    layer = Layer.random(rng, *shape)
    for result in map(within, layer.computed(dev, variant, blocking), layer.expected):
        assert result.share <= 1
    dev.check()


@pytest.mark.parametrize("variant, k", OF_3X3)
@pytest.mark.exact
@pytest.mark.large
def test_a_relu_hides_no_nan(dev, rng, variant, k):
    layer = Layer.random(rng, (9, 11), (16,), 16, k)
    layer.parts[0][4, 5, 6] = np.nan
    bad = np.isnan(layer.computed(dev, variant, CPU)[0]).all(axis=2)
    assert bad[3:6, 4:7].all() and not bad[:, 10].any()
    assert bad.sum() == 9 or variant == WINOGRAD  # Winograd spreads it in its tiles
