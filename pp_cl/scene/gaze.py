"""Finds the place that cameras look at and the direction that is up in their images."""

from collections.abc import Sequence

import numpy as np

from pp_cl.engine.camera import Camera

MOST = 0.9  # share of the cameras that must have the place looked at ahead, or the same side up
RING = 0.2  # eyes form a ring if they spread less than this across it, relative to along it
ASIDE = 35.0  # most degrees between a camera's axis and the place that all look at, in the median
SPREAD = 0.2  # eyes are around the object if they spread by this share of their distance to it
# The mean of the cameras' axes has this length if they go 90 degrees around an object on an arc. It
# is 0.97 and more if they look the same way from a wall; then the place looked at is of no use.
ONE_WAY = 0.9


def up_of(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) unit vector pointing up in the images, as upward() finds it."""
    return upward(cameras)[0]


def upward(cameras: Sequence[Camera]) -> tuple[np.ndarray, str]:
    """((3,) unit vector pointing up, its source if the upper edges of the images are not, or ""):
    as nearly perpendicular to all horizontal edges of the images as possible, on the side of their
    mean upper edge. If upper edges contradict each other, as with pictures on their side, it is
    perpendicular to all vertical edges, or else an axis of the cameras' ring or of the world, and
    points to the side where the cameras are.
    """
    right, down = (np.stack([camera.pose[:, axis] for camera in cameras]) for axis in (0, 1))
    up, side = _across(right, -down), _across(down, right)
    if (-down @ up > 0).mean() >= MOST:
        return up, ""
    eyes = np.stack([camera.eye for camera in cameras])
    above, share = eyes.mean(0) - looked_at(cameras), (right @ side > 0).mean()
    spread, axes = np.linalg.eigh(np.cov(eyes.T))
    if max(share, 1 - share) >= MOST:
        up, by = side, "the images' sides"
    elif spread[0] < RING * spread[1]:
        up, by = axes[:, 0], "the ring of the cameras"
    else:
        up, by = np.eye(3)[np.abs(above).argmax()], "an axis of the world"
    return up if up @ above >= 0 else -up, by


def _across(edges, ends):
    """(3,) unit vector most perpendicular to (N, 3) edges, on the side of the mean (N, 3) end."""
    mean = ends.mean(axis=0)
    # the mean decides if the edges leave more than one direction open
    spread = edges.T @ edges / len(edges) - 0.1 * np.outer(mean, mean)
    direction = np.linalg.eigh(spread)[1][:, 0]
    return direction if direction @ mean >= 0 else -direction


def looked_at(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) the world position nearest to the optical axes of all cameras, in least squares."""
    forward = np.stack([camera.pose[:, 2] for camera in cameras])
    eyes = np.stack([camera.eye for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (N, 3, 3) projectors
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, eyes), rcond=1e-9)[0]


def meeting(cameras: Sequence[Camera]) -> float:
    """ahead(), but 0 for cameras that are not around the place they look at."""
    towards = looked_at(cameras) - np.stack([camera.eye for camera in cameras])
    along = np.stack([camera.pose[:, 2] for camera in cameras])
    spread = np.linalg.norm(towards - towards.mean(0), axis=1).mean()
    distance = np.median(np.linalg.norm(towards, axis=1))
    is_around = spread > SPREAD * distance and np.linalg.norm(along.mean(0)) < ONE_WAY
    return ahead(cameras) if is_around else 0.0


def ahead(cameras: Sequence[Camera]) -> float:
    """The median cosine between the cameras' axes and the direction of the place they look at; 0 if
    the place is not ahead of them.
    """
    towards = looked_at(cameras) - np.stack([camera.eye for camera in cameras])
    along = np.stack([camera.pose[:, 2] for camera in cameras])
    cosine = (along * towards).sum(1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-30)
    is_ahead = (cosine > 0).mean() >= MOST and np.median(cosine) > np.cos(np.radians(ASIDE))
    return float(np.median(cosine)) if is_ahead else 0.0
