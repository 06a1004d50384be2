"""Finds the box of the object that all cameras look at, from sparse points, and a world in which it
is upright, centred and of unit size.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from pp_cl import Camera
from pp_cl.scene import looked_at, up_of
from pp_studio.camera_path import level

SEEN = 0.75  # an object's point is seen by this share of the cameras that see the best-seen points
NEIGHBOURS, LONELY = 8, 3.0  # a point is alone if its 8th neighbour is 3 median distances away
CUT = 0.005  # share of the points at each end of an axis that may be wrong
MARGIN = 0.06  # of the box's diagonal, added on every side, as smooth parts have no points
LEAST_POINTS = 100
FILLED = 0.55  # share of the images that an object fills whose sides may have no points
SLOPES = np.tan(np.radians(np.arange(-10, 11, 2)))  # tried for the plane that carries the object
THICK = 0.01  # of the cameras' distance: most distance of a plane's points from the plane
TABLE, BELOW = 0.08, 0.03  # shares of the points: on a table at least, and below it at most
LEAST_SPREAD = 0.9  # width of a table at least, in widths of the points above it


class World(NamedTuple):
    """A similarity to the scene's world, x -> scale * rotation @ x + shift. box: (2, 3) lower and
    upper corner of the object in that world.
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    box: np.ndarray


def find_world(cameras: Sequence[Camera], points: np.ndarray) -> World:
    """The world whose z axis points up, whose origin is the middle of the object, and in which the
    object's box fits into [-1, 1]. points: (N, 3).
    """
    up = up_of(cameras)
    centre = looked_at(cameras)
    eyes = np.stack([camera.eye for camera in cameras])
    reach = float(np.median(np.linalg.norm(eyes - centre, axis=1)))
    ahead = level(eyes[0] - centre, up)
    rotation = np.stack([ahead, np.cross(up, ahead), up])  # the first camera is towards x
    upright = (points - centre) @ rotation.T / reach
    seen_share = np.mean([camera.pixels(points)[2] for camera in cameras], axis=0)
    on_object = _on_object(upright, seen_share)
    angles = [
        np.arctan(min(camera.width / camera.fx, camera.height / camera.fy) / 2)
        for camera in cameras
    ]
    away = [np.linalg.norm(eye - centre) for eye in eyes]
    # radius of the largest ball around the centre that every camera sees as a whole
    ball = min(far * np.sin(angle) for far, angle in zip(away, angles, strict=True)) / reach
    low, high = np.outer([-ball, ball], np.ones(3))
    if len(on_object) >= LEAST_POINTS:
        ends = np.quantile(on_object, [CUT, 1 - CUT], axis=0)
        margin = MARGIN * np.linalg.norm(ends[1] - ends[0])
        low, high = (
            np.minimum(ends[0] - margin, FILLED * low),
            np.maximum(ends[1] + margin, FILLED * high),
        )
        low[2] = ends[0, 2] - margin  # not FILLED below, where the object stands on something
    middle, size = (low + high) / 2, (high - low).max() / 2
    scale = 1 / (reach * size)
    shift = -scale * rotation @ centre - middle / size
    return World(scale, rotation, shift, np.stack([low - middle, high - middle]) / size)


def _on_object(points, seen_share):
    """(M, 3) the points that nearly all cameras see and that are not alone, without a table's."""
    near = np.linalg.norm(points, axis=1) < 1
    if not near.any():
        return points[near]
    on_object = points[near & (seen_share >= SEEN * np.quantile(seen_share[near], 0.95))]
    if len(on_object) <= NEIGHBOURS:
        return on_object
    away = cKDTree(on_object).query(on_object, NEIGHBOURS + 1)[0][:, -1]
    on_object = on_object[away < LONELY * np.median(away)]
    table = _table(on_object)
    return on_object if table is None else on_object[on_object @ table[:3] > table[3] + THICK]


def _table(points):
    """(4,) normal and height of the nearly level plane on which the points stand, or None."""
    best, plane = TABLE * len(points), None
    for x, y in product(SLOPES, SLOPES):
        normal = np.array([x, y, 1]) / np.sqrt(x * x + y * y + 1)
        height = points @ normal
        order = np.sort(height)
        first = order[: int(BELOW * len(points)) + 1]  # candidates for the layer's lowest point
        inside = np.searchsorted(order, first + 2 * THICK) - np.arange(len(first))
        if inside.max() <= best:
            continue
        middle = first[inside.argmax()] + THICK
        on, above = np.abs(height - middle) <= THICK, height > middle + THICK
        if not above.any():
            continue
        # widths in x and y, without some points at the ends
        ends = [np.quantile(points[part, :2], [0.05, 0.95], axis=0) for part in (on, above)]
        if (np.ptp(ends[0], axis=0) > LEAST_SPREAD * np.ptp(ends[1], axis=0)).all():
            best, plane = inside.max(), np.append(normal, middle)
    return plane


def corners_of(box: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a (2, 3) box: bit i of a row's index says whether the corner lies on the
    upper side of axis i.
    """
    return np.array([[box[n >> axis & 1][axis] for axis in range(3)] for n in range(8)])
