"""What the selftest does not test of Adam, RMSprop and averages."""

from dataclasses import replace

import numpy as np
import pytest
from support.comparisons import relative_error
from support.models import make_model

from pp_cl.engine.layers.conv import GradientParts
from pp_cl.engine.raster.points import SH_DEGREES
from pp_cl.engine.stored import optimiser_arrays
from pp_cl.engine.training.optim import Optimiser, adam_update, ema_update
from pp_cl.engine.training.state import PointState
from pp_cl.reference import dense, optim
from pp_cl.selftest.optim import EYE, RATES, Cloud, gradients

pytestmark = pytest.mark.kernels  # they test adam.cl and rmsprop.cl


def test_refuses_different_shapes(dev):
    a, b = dev.zeros((4, 3)), dev.zeros((3, 4))
    parts = GradientParts(1, dev.zeros((1, 8), np.int32), a)
    with pytest.raises(ValueError, match="one shape"):
        adam_update(dev, a, parts, {"m": a, "v": b}, step=1, rate=0.1, eps=1e-8)
    with pytest.raises(ValueError, match="one shape"):
        ema_update(dev, a, b, 0.5)


def test_averages_start_as_copies_and_are_applied_and_released(dev, rng):
    model = make_model(dev, rng)
    optimiser = Optimiser(dev, model, PointState(dev, model.cloud))
    before = dev.bytes
    learned = model.cloud.learned()
    for name in ("sh_1", "sh_2a", "sh_2b"):  # these have no averages
        learned.pop(name)
    parameters = learned | model.net.parameters
    start = {name: array.get() for name, array in parameters.items()}
    optimiser.update_ema(0.25)  # the first update copies, whatever its weight
    for array in parameters.values():
        dev.fill(array, 0)
    optimiser.update_ema(0.25)
    stored = {*optimiser_arrays(optimiser)}
    assert {name.split(".", 1)[0] for name in stored} == {"state", "moment", "average"}
    assert {f"state.a.{name}" for name in learned} < stored and "state.a.sh_1" not in stored
    optimiser.apply_ema()
    assert dev.bytes == before
    for name, array in parameters.items():
        np.testing.assert_allclose(array.get(), 0.75 * start[name], rtol=1e-6)
        dev.fill(array, 0)
    optimiser.apply_ema()  # no averages are left
    assert not any(array.get().any() for array in parameters.values())


def test_rmsprop_is_adam_without_a_first_moment_on_the_average_over_directions(rng):
    """Tests the oracle: for one gradient seen from everywhere, v is the mean of the v that Adam
    keeps of the coefficients, and the moves are Adam's with that mean.
    """
    directions = dense.directions(rng.standard_normal((20_000, 3)), np.zeros(3))
    basis = dense.sh_basis(directions)
    grad = 1e-4 * np.ones((len(basis), 16))
    others = {"offset": np.zeros((len(basis), 4))}
    values = {"sh": np.zeros((len(basis), 9, 16)), "opacity": np.zeros((len(basis), 9))} | others
    others["opacity"] = np.zeros(len(basis))
    twin = optim.RmsProp(values, directions, 0.5)
    adam = optim.Adam(np.zeros((len(basis), 9, 16)), beta1=0.0)
    rates = {"sh": np.ones(9), "offset": 0, "opacity": 0, "lobe": 0}
    twin.step(1, {"sh": grad} | others, rates, {"sh": 0.0, "offset": 1.0, "opacity": 1.0})
    adam.step(basis[:, :, None] * grad[:, None], 1.0, 0.0)
    np.testing.assert_allclose(adam.v[:, :, 0].mean(axis=0), twin.v["sh"][0, 0], rtol=0.03)
    for degree in SH_DEGREES:
        of_degree = adam.v[:, degree**2 : (degree + 1) ** 2, 0].mean(axis=1)
        np.testing.assert_allclose(of_degree, twin.v["sh"][:, 0], rtol=1e-9)  # in every direction
    shared = np.sqrt(adam.v / twin.v["sh"][:, None])
    np.testing.assert_allclose(adam.parameter * shared, twin.values["sh"], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rates", [(0.1, 0, 0), (0.1, 0.05, 0), (0, 0.05, 0.02), (0, 0, 0)])
def test_degrees_at_rate_0_stay(dev, rng, rates):
    cloud = Cloud(dev, rng, 31)
    for _ in range(3):
        cloud.step(gradients(rng, 31), np.arange(31), rates=replace(RATES, sh=rates))
    sh = cloud.learned()["sh"]
    assert relative_error(sh, cloud.twin.values["sh"]) < 1e-6
    for degree, rate in enumerate(rates):
        part = np.s_[:, degree**2 : (degree + 1) ** 2]
        assert (sh[part] == cloud.start["sh"][part]).all() == (rate == 0)


def test_an_opacity_moves_as_it_changes_with_what_is_learned(dev, rng):
    """Compare with finite differences of the float64 opacity from the eye, inside its bounds: the
    first step of RMSprop is the rate times the sign of the gradient.
    """
    cloud = Cloud(dev, rng, 31)
    start = np.hstack([rng.uniform(0.4, 0.6, (31, 1)), rng.uniform(-0.1, 0.1, (31, 8))])
    cloud.cloud.opacity.set(start.astype(np.float32))
    grads = gradients(rng, 31)
    cloud.step(grads, np.arange(31), rates=replace(RATES, opacity=0.1, lobe=0.1))
    slope = np.empty((31, 9))
    for k in range(9):
        step = 1e-6 * np.eye(9)[k]
        higher, lower = (dense.opacities(cloud.positions, EYE, start + s) for s in (step, -step))
        slope[:, k] = (higher - lower) / 2e-6
    moved = cloud.cloud.opacity.get() - start
    rates = np.repeat([0.1, 0.1, 0.05], (1, 3, 5))
    expected = -rates * np.sign(grads["opacity"])[:, None] * slope
    np.testing.assert_allclose(moved, expected, atol=1e-6)
