"""Correct cameras that do not look at one place do not lead to a message about wrong axes."""

import numpy as np
import pytest

from pp_cl.engine.camera import Camera
from pp_cl.scene.verdict import other_axes

COUNT = 24
STATES = "camera-to-world", "opengl"
ORIGINS = ((0, 0, 0), (2, -3, 1), (30, 10, -20))


def rotation(rng):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return turn * np.sign(np.linalg.det(turn))


def wall(rng, aim):
    """Eyes on a square, which all look the same way at a wall, give or take `aim`."""
    eyes = np.c_[rng.uniform(-0.3, 0.3, (COUNT, 2)), np.zeros(COUNT)]
    return eyes, eyes + [0, 0, 1] + rng.normal(0, aim, (COUNT, 3))


def converging(rng):
    eyes, _ = wall(rng, 0)
    return eyes, np.tile([0.0, 0.0, 1.0], (COUNT, 1))


def walk(rng):
    eyes = np.c_[np.linspace(0, 5, COUNT), np.zeros((COUNT, 2))]
    return eyes, eyes + [0, 0, 4] + rng.normal(0, 0.3, (COUNT, 3))


def arc(rng, angle):
    along, height = rng.uniform(0, angle, COUNT), rng.uniform(-0.2, 0.8, COUNT)
    eyes = 3 * np.c_[np.cos(along) * np.cos(height), np.sin(height), np.sin(along) * np.cos(height)]
    return eyes, rng.normal(0, 0.1, (COUNT, 3))


CAPTURES = {
    "held by hand": lambda rng: wall(rng, 0.2),
    "converging": converging,
    "walk": walk,
    "long arc": lambda rng: arc(rng, 4),
}


def cameras(capture, seed, origin):
    rng = np.random.default_rng(seed)
    eyes, targets = capture(rng)
    turn = rotation(rng)
    up = turn @ [0.001, 1, 0]
    return [
        Camera.look_at(turn @ eye + origin, turn @ target + origin, up, fx=100, width=99, height=99)
        for eye, target in zip(eyes, targets, strict=True)
    ]


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("capture", CAPTURES)
def test_right_axes_are_not_doubted(capture, origin):
    for seed in range(20):
        assert other_axes(cameras(CAPTURES[capture], seed, origin), STATES) is None
