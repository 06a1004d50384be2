import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_studio.capture.box import MARGIN, find_world

RADIUS, WIDE = 0.8, 1.1  # the ball's radius; half the width of the cloth below it


def upright(vectors, tilt):
    """(N, 3) vectors in a world whose table is tilted by `tilt` radians."""
    return vectors @ np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    )


@pytest.mark.parametrize("share", [0.1, 0.3])
@pytest.mark.parametrize("tilt", [0, 0.05, 0.1])
def test_a_table_is_no_part_of_the_object(share, tilt):
    """The box is the same whichever points were found on ball and table."""
    rng = np.random.default_rng(0)
    cameras, sizes = ring_cameras(12, 100), []
    for _ in range(8):
        ball = rng.normal(size=(2000, 3))
        ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
        cloth = rng.uniform(-WIDE, WIDE, (int(2000 * share / (1 - share)), 3))
        cloth[:, 2] = rng.normal(-RADIUS, 0.005, len(cloth))
        world = find_world(cameras, upright(np.concatenate([ball, cloth]), tilt))
        sizes.append(np.ptp(world.box, axis=0) / world.scale)
    assert np.ptp(sizes, axis=0).max() < 0.05
    assert np.mean(sizes, axis=0) == pytest.approx(
        2 * RADIUS * (1 + 2 * MARGIN * np.sqrt(3)), abs=0.1
    )


def test_a_base_is_part_of_the_object():
    """It is narrower than the object on it."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3))
    ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
    base = 0.8 * RADIUS * rng.uniform(-1, 1, (660, 3))
    base[:, 2] = -RADIUS
    base[:60, 2] -= rng.uniform(0, 0.4, 60)  # its side has few points
    world = find_world(ring_cameras(12, 100), np.concatenate([ball, base]))
    low = (world.box[0, 2] - world.shift[2]) / world.scale
    assert low < -RADIUS - 0.3
