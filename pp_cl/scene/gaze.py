"""Where cameras look, and what is up in their images."""

from collections.abc import Sequence

import numpy as np

from pp_cl.engine.camera import Camera

MOST = 0.9  # of the cameras, that have before them what all look at
ASIDE = 35.0  # degrees between a camera's axis and what all look at, in the median
SPREAD = 0.2  # of the distance to what they look at, by which eyes differ around an object
# the length of the mean of the axes: of cameras that go 90 degrees around an object on an arc. Of
# those that look the same way from a wall, 0.97 and more, the place all look at is of no use.
ONE_WAY = 0.9


def up_of(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) unit vector that is up in the images: as far as possible across all horizontal edges of
    the images, on the side of their mean upper edge.
    """
    right, up = (np.stack([camera.pose[:, axis] for camera in cameras]) for axis in (0, 1))
    mean = -up.mean(axis=0)
    # the mean decides where the right axes leave more than one direction open
    spread = right.T @ right / len(cameras) - 0.1 * np.outer(mean, mean)
    direction = np.linalg.eigh(spread)[1][:, 0]
    return direction if direction @ mean >= 0 else -direction


def looked_at(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) the world position nearest to the optical axes of all cameras, by least squares."""
    forward = np.stack([camera.pose[:, 2] for camera in cameras])
    eyes = np.stack([camera.eye for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (N, 3, 3) projectors
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, eyes), rcond=1e-9)[0]


def meeting(cameras: Sequence[Camera]) -> float:
    """ahead(), but 0 for cameras that do not look at it from around."""
    towards = looked_at(cameras) - np.stack([camera.eye for camera in cameras])
    along = np.stack([camera.pose[:, 2] for camera in cameras])
    spread = np.linalg.norm(towards - towards.mean(0), axis=1).mean()
    distance = np.median(np.linalg.norm(towards, axis=1))
    is_around = spread > SPREAD * distance and np.linalg.norm(along.mean(0)) < ONE_WAY
    return ahead(cameras) if is_around else 0.0


def ahead(cameras: Sequence[Camera]) -> float:
    """The median cosine between cameras' axes and what they look at, 0 where it is not ahead."""
    towards = looked_at(cameras) - np.stack([camera.eye for camera in cameras])
    along = np.stack([camera.pose[:, 2] for camera in cameras])
    cosine = (along * towards).sum(1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-30)
    is_ahead = (cosine > 0).mean() >= MOST and np.median(cosine) > np.cos(np.radians(ASIDE))
    return float(np.median(cosine)) if is_ahead else 0.0
