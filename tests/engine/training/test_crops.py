from dataclasses import replace

import numpy as np
import pytest

from pp_cl.engine.camera import Camera
from pp_cl.engine.training.crops import BETWEEN, Crops
from pp_cl.engine.views import View
from pp_cl.settings import TrainConfig

CAMERA = Camera(np.eye(3, 4), 90.0, 95.0, 31.6, 32.2, 64, 64)
OPAQUE = View("a.png", CAMERA, np.full((64, 64, 4), 255, np.uint8))


def jitters(view, **settings):
    """(100, 2) jitters of the crops of 100 steps, whose cameras must be shifted to match."""
    crops = [Crops([view], TrainConfig(crop=32, **settings), 0).draw(step) for step in range(100)]
    for crop in crops:
        shift = np.array(crop.jitter) / view.downscale + crop.box[:2]
        moved = view.camera.cx - crop.camera.cx, view.camera.cy - crop.camera.cy
        assert np.abs(moved - shift).max() < 1e-9
    return np.array([crop.jitter for crop in crops])


def test_a_reduced_view_has_all_blocks_of_stored_pixels():
    shifts = jitters(OPAQUE.reduced(2))
    assert {tuple(jitter) for jitter in shifts.tolist()} == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_a_view_at_its_own_size_is_shifted_between_its_pixels():
    shifts = jitters(OPAQUE)
    assert np.abs(shifts).max() <= BETWEEN and (np.ptp(shifts, axis=0) > 1.8 * BETWEEN).all()


@pytest.mark.parametrize("downscale", (1, 2))
def test_it_can_be_switched_off(downscale):
    assert not jitters(OPAQUE.reduced(downscale), pixel_jitter=False).any()


def test_pixels_that_say_nothing_do_not_spread():
    hand = np.zeros((64, 64), bool)
    hand[:9] = True
    assert not jitters(replace(OPAQUE, ignored=hand)).any()
