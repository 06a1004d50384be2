"""The mask term against float64, and that it takes away what exceeds the outline and fills what
looks like the background.
"""

import numpy as np
import pytest
from support.comparisons import relative_error
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl import load
from pp_cl.cli import main
from pp_cl.training.mask import MaskLoss

WEIGHT, SHORTFALL = 0.7, 0.3


def added(dev, transmittance, mask, offset, size):
    """(terms, dL/dalpha (PH, PW), what the log says) of terms that begin as 1, 2, 3, 4."""
    loss, terms = MaskLoss(dev, WEIGHT), dev.upload([1, 2, 3, 4], np.float32)
    for _ in range(2):  # the buffers are used again
        terms.set(np.float32([1, 2, 3, 4]))
        gradient = loss.add(
            dev.upload(transmittance, np.float32),
            dev.upload(mask, np.float32),
            size=size,
            offset=offset,
            shortfall=SHORTFALL,
            terms=terms,
        )
    return (
        terms.get(),
        gradient.get().reshape(size),
        {name: r.get()[0] for name, r in loss.terms().items()},
    )


@pytest.mark.parametrize("side", [1, 31, 33, 257])
def test_matches_float64(dev, rng, side):
    h, w, left, top = side, 29, 3, 1
    size = (side + 3, 36)
    transmittance, mask = rng.random(size), rng.random((h, w))
    terms, gradient, logged = added(dev, transmittance.ravel(), mask, (left, top), size)

    def term(t):
        difference = 1 - t[top : top + h, left : left + w] - mask
        return WEIGHT * np.mean(np.where(difference < 0, SHORTFALL, 1) * difference**2)

    assert terms[0] == pytest.approx(1 + term(transmittance), rel=1e-6)
    assert terms[1:].tolist() == [2, 3, 4]
    assert logged["mask"] == pytest.approx(term(transmittance) / WEIGHT, rel=1e-5)
    expected = np.zeros(size)
    for y, x in [(top, left), (top + h - 1, left + w - 1), (top + h // 2, left + w // 2)]:
        moved = [transmittance.copy() for _ in range(2)]
        moved[0][y, x] += 1e-4
        moved[1][y, x] -= 1e-4
        # the alpha is 1 - T
        expected[y, x] = (term(moved[1]) - term(moved[0])) / 2e-4
        assert gradient[y, x] == pytest.approx(expected[y, x], rel=1e-4, abs=1e-9)
    analytic = np.zeros(size)
    inside = np.s_[top : top + h, left : left + w]
    difference = 1 - transmittance[inside] - mask
    weights = WEIGHT * np.where(difference < 0, SHORTFALL, 1)
    analytic[inside] = 2 * weights * difference / (h * w)
    assert relative_error(gradient, analytic) < 1e-6
    outside = np.ones(size, bool)
    outside[top : top + h, left : left + w] = False
    assert not gradient[outside].any()


def test_nothing_without_a_weight_a_mask_or_a_transmittance(dev):
    terms, there = dev.zeros((4,)), dev.zeros((64,))
    places = {"size": (8, 8), "offset": (0, 0), "shortfall": 1.0, "terms": terms}
    before = dev.bytes
    assert MaskLoss(dev, 0.0).add(there, there.reshape(8, 8), **places) is None
    for given in ((None, there.reshape(8, 8)), (there, None)):
        loss = MaskLoss(dev, 1.0)
        assert loss.add(*given, **places) is None and loss.terms() == {}
    assert dev.bytes == before and not terms.get().any()


def test_the_mask_is_learned(tmp_path):
    """The alpha of the test views is nearer to that of the photographs, and exceeds it less."""
    scene, errors = write_ball_scene(tmp_path / "ball"), []
    for weight in (0, 3):
        out = tmp_path / str(weight)
        assert main(arguments(scene, out, train__mask_weight=weight)) == 0
        run = load(out)
        views = run.scene("test").splits["test"]
        alphas = [(run.render(view.camera).alpha, reduced_alpha(view)) for view in views]
        difference = np.array([rendered - given for rendered, given in alphas])
        errors.append((np.maximum(difference, 0).mean(), np.maximum(-difference, 0).mean()))
    (excess, shortfall), (excess_left, shortfall_left) = errors
    assert excess_left < 0.8 * excess and shortfall_left < 0.9 * shortfall


def reduced_alpha(view):
    """(H, W) of the reduced photograph."""
    k, camera = view.downscale, view.camera
    alpha = view.image[..., 3].reshape(camera.height, k, camera.width, k)
    return alpha.mean(axis=(1, 3)) / 255
