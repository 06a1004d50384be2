"""cl/layers/winograd_transform.cl against float64: every transformed weight, the powers of two that
half is scaled by.
"""

import numpy as np
import pytest
from oracle.conv import conv
from support.winograd_layers import form, transformed_by_device

from pp_cl.layers.variants import VARIANTS
from pp_cl.layers.winograd_transform import transform_flipped_weights, transform_weights
from pp_cl.reference.network import flipped
from pp_cl.reference.winograd import ROUNDING, SMALLEST, convolve, matrices
from pp_cl.reference.winograd import transform_weights as exact_weights

FORMS = [(v.winograd_m, v.half) for v in VARIANTS.values() if v.winograd_m]
SHAPES = [(16, 16), (48, 16), (16, 80), (64, 32), (272, 144)]  # channels in, out
# float32's rounding times the operations, in a row, that make one transformed weight
FLOAT = 2.0**-24 * 12


def wide_layer(rng, ci, co):
    """Weights over twelve decades: the largest of a channel is one of a kind."""
    return (10 ** rng.uniform(-6, 6, (co, ci, 3, 3)) * rng.choice([-1, 1], (co, ci, 3, 3))).astype(
        np.float32
    )


def check(m, half, units, actual, weight):
    """Every transformed weight is within its own rounding of float64's; units are what brings the
    largest to 2^13.
    """
    if half:
        # 2^13 is 0.5 * 2^14
        _, exponents = np.frexp(np.abs(weight).max((1, 2, 3)).astype(np.float64) + 2.0**-130)
        np.testing.assert_array_equal(units, np.ldexp(1.0, np.maximum(exponents - 14, -126)))
    expected, terms = exact_weights(m, weight), exact_weights(m, weight, magnitude=True)
    bound = FLOAT * terms
    if half:
        bound = bound * (1 + ROUNDING) + np.maximum(
            ROUNDING * np.abs(expected), SMALLEST / 2 * units[:, None]
        )
    assert (np.abs(actual - expected) <= bound).all()


def test_the_oracle():
    """The matrices are Winograd's, and the sums the convolution's."""
    rng = np.random.default_rng(0)
    x, weight = rng.normal(size=(7, 10, 3)), rng.normal(size=(4, 3, 3, 3))
    for m in (2, 4):
        np.testing.assert_allclose(
            convolve(m, x, exact_weights(m, weight)), conv(x, weight, np.zeros(4)), atol=1e-12
        )
    np.testing.assert_allclose(
        matrices(2)[2], [[1, 0, -1, 0], [0, 1, 1, 0], [0, -1, 1, 0], [0, -1, 0, 1]], atol=1e-12
    )


@pytest.mark.parametrize("m, half", FORMS)
@pytest.mark.parametrize("ci, co", SHAPES)
def test_weights(dev, rng, ci, co, m, half):
    weight = wide_layer(rng, ci, co)
    check(m, half, *transformed_by_device(dev, m, half, weight), weight)


@pytest.mark.parametrize("m, half", FORMS)
@pytest.mark.parametrize("ci, co", SHAPES)
def test_flipped_weights(dev, rng, ci, co, m, half):
    weight = wide_layer(rng, ci, co)
    for first, c in {(0, ci), (ci - 16, 16), (ci // 32 * 16, ci - ci // 32 * 16)}:
        check(
            m,
            half,
            *transformed_by_device(dev, m, half, weight, True, first, c),
            flipped(weight)[first : first + c],
        )


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("exponent", [-80, -17, 24, 100])
def test_no_size_of_weights_changes_what_half_keeps(dev, rng, exponent, flip):
    weight = wide_layer(rng, 32, 48)
    part = (True, 0, 32) if flip else ()
    units, expected = transformed_by_device(dev, 4, True, weight, *part)
    larger_units, actual = transformed_by_device(dev, 4, True, np.ldexp(weight, exponent), *part)
    np.testing.assert_array_equal(larger_units, np.ldexp(units, exponent))
    np.testing.assert_array_equal(actual, np.ldexp(expected, exponent))


@pytest.mark.parametrize("flip", [False, True])
def test_half_at_the_limits(dev, rng, flip):
    """Beyond half's own range on both sides, up to float's; zeros; small weights beside large
    ones.
    """
    sizes = np.array([0, 1e-45, 1e-38, 1e-7, 6e4, 65504, 65520, 1e5, 3.4e38])
    weight = np.zeros((32, 32, 3, 3), np.float32)
    for i, size in enumerate(sizes):
        weight[i, i] = size * rng.choice([-1, 1], (3, 3))
    # in one output and in one input channel
    weight[20, 20], weight[20, 21], weight[21, 20] = 6e4, 1e-7, 1e-7
    units, stored = transformed_by_device(dev, 4, True, weight, *((True, 0, 32) if flip else ()))
    check(4, True, units, stored, flipped(weight) if flip else weight)
    assert (stored[..., range(4, 9), range(4, 9)] != 0).any((0, 1)).all()
    assert (stored[..., 3, 3] != 0).any() and not stored[..., 9:20, :].any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("flip", [False, True])
def test_half_hides_nothing_that_is_not_finite(dev, rng, flip, bad):
    weight = wide_layer(rng, 32, 32)
    weight[5, 6, 1, 1] = bad
    _, stored = transformed_by_device(dev, 4, True, weight, *((True, 0, 32) if flip else ()))
    wrong = ~np.isfinite(stored)
    assert wrong[1, 1].sum() == 1 and wrong[1, 1, 6 if flip else 5, 5 if flip else 6]
    assert wrong.sum() == wrong.any((2, 3)).sum()


def test_wrong_shapes_are_refused(dev):
    weight = dev.zeros((2, 3, 3, 16, 16))
    transformed = dev.zeros(form(4).transformed_floats(16, 32))
    with pytest.raises(ValueError, match="transformed weights of 10 floats"):
        transform_weights(dev, form(4), weight, dev.zeros(10))
    half = form(4, half=True)
    with pytest.raises(ValueError, match="transformed weights"):
        transform_weights(dev, half, weight, dev.zeros(half.transformed_floats(16, 32) - 1))
    for first, c in ((0, 3), (8, 16), (16, 16)):
        with pytest.raises(ValueError, match=f"{c} channels from {first}"):
            transform_flipped_weights(dev, form(4), weight, first, c=c, transformed=transformed)
