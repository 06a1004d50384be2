"""pp_cl/layers/policy.py: which variant a convolution takes."""

import numpy as np
import pytest
from oracle.unet import unet
from support.comparisons import relative_error
from support.conv_layers import layer as layer_weights
from support.networks import plain_parameters
from support.tunings import MS, REL_L2, row, tuning_of
from support.winograd_layers import form, run_backward_weights, run_forward

from pp_cl.bench.conv import RandomConv
from pp_cl.bench.timing import errors
from pp_cl.errors import UserError
from pp_cl.layers.choice import CHOICES, VARIANTS, ConvShape, fastest, make_policy, offered
from pp_cl.layers.conv import Direction
from pp_cl.network.unet import UNet

DEFAULT = 1e-5
FORWARD = Direction.FORWARD


def pick(dev, rows, tolerance=DEFAULT, pixels=64 * 64, ci=64):
    policy = make_policy(dev, tolerance, tuning_of(dev, rows))
    return policy.choose(ConvShape(FORWARD, 3, (ci,), 32, pixels))


# ---- the choice


def test_the_fastest_is_taken_and_the_shipped_one_in_doubt():
    assert fastest({"a": 2.0, "b": 1.0}, "a") == "b"
    assert fastest({"a": 1.02, "b": 1.0}, "a") == "a"
    assert fastest({"b": 1.0, "c": 0.99}, "a") == "c"  # the shipped one was not timed
    assert fastest({}, "a") == "a"


@pytest.mark.usefixtures("cpu_form")
def test_a_measured_layer_takes_its_fastest_variant(dev):
    assert pick(dev, [row()]) == "winograd2"
    assert (
        pick(dev, [row(ms=MS | {"winograd2": 1.99})]) == "winograd4"
    )  # shipped, and hardly slower
    # of another version
    assert pick(dev, [row(ms=MS | {"fft": 0.1}, rel_l2=REL_L2 | {"fft": 0.0})]) == "winograd2"
    # all that this layer can run
    assert (
        make_policy(dev, DEFAULT, tuning_of(dev, [row(ci=20)])).choose(
            ConvShape(FORWARD, 3, (20,), 32, 64 * 64)
        )
        == "direct"
    )


@pytest.mark.usefixtures("cpu_form")
def test_other_layers_are_taken_as_shipped(dev):
    assert pick(dev, []) == "winograd4"
    for change in ({"ci": 32}, {"co": 64}, {"k": 1}, {"direction": "input"}):
        assert pick(dev, [row(**change)]) == "winograd4"


@pytest.mark.usefixtures("cpu_form")
def test_the_nearest_size_counts_within_a_factor_of_four(dev):
    rows = [row(10_000, MS | {"direct": 0.1}), row(100_000)]
    assert (
        pick(dev, rows, pixels=30_000) == "direct" and pick(dev, rows, pixels=32_000) == "winograd2"
    )
    assert (
        pick(dev, rows, pixels=2_500) == "direct" and pick(dev, rows, pixels=2_499) == "winograd4"
    )
    assert (
        pick(dev, rows, pixels=400_000) == "winograd2"
        and pick(dev, rows, pixels=400_001) == "winograd4"
    )


@pytest.mark.usefixtures("cpu_form")
def test_a_variant_beyond_the_tolerance_is_not_taken(dev):
    assert pick(dev, [row(ms=MS | {"winograd4": 0.1})], 5e-7) == "winograd4"
    assert pick(dev, [row(ms=MS | {"winograd4": 0.1})], 4.9e-7) == "winograd2"
    assert pick(dev, [row(ms=MS | {"direct": 0.1, "winograd4": 0.1})], 1e-7) == "winograd2"
    assert pick(dev, [], VARIANTS["winograd4"].errors[3][FORWARD]) == "winograd4"
    assert pick(dev, [], VARIANTS["direct"].errors[3][FORWARD]) == "winograd2"


@pytest.mark.usefixtures("cpu_form")
def test_what_no_variant_keeps_is_refused_with_the_least(dev):
    with pytest.raises(
        UserError,
        match=r"tolerance 6e-07: .*64 to 32.*\(forward\).*winograd2, as shipped.*allow 7e-07",
    ):
        pick(dev, [], 6e-7)
    # one more layer, less exact: the number that is named suffices for all
    rows = [row(), row(ci=512, rel_l2=dict.fromkeys(VARIANTS, 3.14159e-7))]
    with pytest.raises(
        UserError, match=r"at least \(winograd2, measured on this device\); allow 3.2e-07 or more"
    ):
        pick(dev, rows, 1e-8)
    assert pick(dev, rows, 3.2e-7) == "winograd2"
    assert pick(dev, rows, 3.2e-7, ci=512) in VARIANTS


def test_the_named_least_suffices(dev):
    """Whatever convolution the number is asked for, it lets that one through."""
    for exponent in range(-70, -60):
        error = 10 ** (exponent / 10)
        rows = [row(rel_l2=dict.fromkeys(VARIANTS, error))]
        with pytest.raises(UserError) as refused:
            pick(dev, rows, error * 0.5)
        assert pick(dev, rows, float(str(refused.value).split("allow ")[1].split()[0])) in VARIANTS


@pytest.mark.parametrize("direction", Direction)
def test_the_default_tolerance_allows_the_shipped_choice(dev, direction):
    for side in (1, 9, 20, 64):
        shape = ConvShape(direction, 3, (64,), 64, side**2)
        assert make_policy(dev, DEFAULT).choose(shape) == make_policy(dev).choose(shape)


@pytest.mark.parametrize(
    "sources, co, side, k",
    [
        ((16,), 16, 97, 3),
        ((64, 64), 32, 31, 3),
        ((512,), 32, 9, 3),
        ((48,), 3, 64, 1),
    ],
)
@pytest.mark.parametrize("direction", Direction)
def test_shipped_errors_bound_what_is_measured(dev, direction, sources, co, side, k):
    conv = RandomConv(dev, k, side, sources, co=co)
    for variant in conv.variants:
        if direction not in VARIANTS[variant].errors[k]:
            continue  # the same kernel as another's
        bound = VARIANTS[variant].errors[k][direction]
        assert errors(*conv.result(variant, direction, make_policy(dev)))[0] <= bound


# ---- on a device


@pytest.mark.usefixtures("cpu_form")
def test_a_network_takes_what_was_tuned(dev, rng):
    """Rows that make one variant the fastest everywhere give the bits of a network of that
    variant.
    """
    x = dev.upload(rng.normal(size=(32, 32, 16)).astype(np.float32))
    expected = {
        variant: UNet(dev, (16, 16, 16), policy=make_policy(dev, variant=variant))
        .forward(x, False)
        .get()
        for variant in offered("CPU")
    }
    assert len({image.tobytes() for image in expected.values()}) == len(expected)
    for variant in expected:
        ms = dict.fromkeys(VARIANTS, 2.0) | {variant: 1.0}
        errors = dict.fromkeys(VARIANTS, 1e-7)
        rows = [row(side**2, ms, errors, ci=ci, co=16) for side in (8, 16, 32) for ci in (16, 32)]
        policy = make_policy(dev, DEFAULT, tuning_of(dev, rows))
        net = UNet(dev, (16, 16, 16), policy=policy)
        np.testing.assert_array_equal(net.forward(x, False).get(), expected[variant])


def test_a_network_within_a_tolerance(dev, rng):
    x = rng.normal(size=(64, 64, 16)).astype(np.float32)
    net = UNet(dev, (16, 16, 16), policy=make_policy(dev, 7e-7))
    exact = unet(x, plain_parameters(net, net.parameters))[0]
    assert relative_error(net.forward(dev.upload(x), False).get(), exact) < 2e-6
    with pytest.raises(UserError, match="tolerance 7e-07.*input"):
        net.memory_plan(64, 64, True)
    net.use(make_policy(dev, 1e-9))
    with pytest.raises(UserError, match="tolerance 1e-09"):
        net.memory_plan(64, 64, False)


def all_values(field):
    """The values of a field of Blocking for both classes of devices, which are right on any."""
    return list(dict.fromkeys(v for choices in CHOICES.values() for v in choices.get(field, ())))


# Their many builds take half a minute each.
WINOGRADS = ("winograd", "winograd_narrow", "winograd_weights")
BUILDS_MANY = [pytest.param(field, marks=pytest.mark.slow) for field in WINOGRADS]


@pytest.mark.parametrize("field", [*BUILDS_MANY, "direct"])
def test_every_blocking_computes_the_same(dev, field):
    variants = ["direct"] if field == "direct" else ["winograd2", "winograd4"]
    layers = [((32, 16), 32, 13), ((16,), 48, 7), ((16,), 16, 3)]
    if field == "winograd":
        layers = [((80, 64), 128, 13), ((144,), 128, 3)]
    convolutions = [RandomConv(dev, 3, side, sources, co=co) for sources, co, side in layers]
    for value in all_values(field):
        policy = make_policy(dev, DEFAULT, tuning_of(dev, blocking={field: value}))
        for conv in convolutions:
            for variant in variants:
                for direction in Direction:
                    error = errors(*conv.result(variant, direction, policy))[0]
                    assert error < 2e-6, (value, variant, direction)


@pytest.mark.parametrize("field", [*BUILDS_MANY[:2], "winograd_weights"])
def test_every_blocking_stays_in_the_memory_it_asks_for(dev, rng, field):
    """Images of more tiles than are taken at a time, and as much scratch memory as these blockings
    need, no more.
    """
    # wide: no narrow weights, and two full parts of them
    x, wide = (rng.normal(size=(50, 31, c)).astype(np.float32) for c in (16, 256))
    narrow = layer_weights(rng, 16, 16, 3)
    for value in all_values(field):
        blocking = make_policy(dev, DEFAULT, tuning_of(dev, blocking={field: value})).blocking
        for m in (2, 4):
            of = form(m, blocking=blocking)
            if field == "winograd":
                parameters = layer_weights(rng, 256, 80, 3)
                assert np.isfinite(run_forward(dev, of, wide, *parameters, relu=False)).all()
            elif field == "winograd_narrow":
                assert np.isfinite(run_forward(dev, of, x, *narrow, relu=False)).all()
            else:
                assert np.isfinite(run_backward_weights(dev, of, wide[..., :128], wide)[0]).all()
            dev.check()


@pytest.mark.parametrize(
    "blocking",
    [
        {"winograd": (128, 8), "winograd_weights": 64},
        {"winograd": (32, 8), "direct": (4, 2, (1, 1, 1))},
    ],
)
def test_memory_plan_follows_the_blocking(dev, blocking):
    policy = make_policy(dev, DEFAULT, tuning_of(dev, blocking=blocking))
    x, grad_y = dev.zeros((32, 36, 16)), dev.zeros((32, 36, 3))
    before = dev.bytes
    net = UNet(dev, (16, 32, 48), policy=policy)
    net.forward(x)
    net.backward(grad_y)
    assert dev.bytes - before == sum(size for _, _, size in net.memory_plan(32, 36, True))
