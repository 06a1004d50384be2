"""Where cameras look, what is up in their images, and whether their matrices are to be read in
another way: files in the form of NeRF-synthetic come with axes of OpenCV, and inverted.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.scene.readers.frame import GL_FROM_CV

STATED = "stated"
# {name: (whether the matrices are those from the world, whether their y and z axes point the other
# way than the format has it)}
AXES = {STATED: (False, False), "opencv": (False, True)}
AXES |= {"world-to-camera": (True, False), "opencv world-to-camera": (True, True)}
LEAST_CAMERAS = 4
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


def read_as(camera: Camera, axes: str) -> Camera:
    """The camera that the same matrix gives in a convention out of AXES."""
    inverted, flipped = AXES[axes]
    stored = np.vstack([camera.pose, [0, 0, 0, 1]]) @ GL_FROM_CV
    stored = np.linalg.inv(stored) if inverted else stored
    pose = stored if flipped else stored @ GL_FROM_CV
    return replace(camera, pose=pose[:3])


def meeting(cameras: Sequence[Camera]) -> float:
    """The median cosine between cameras' axes and what they look at from around it, else 0."""
    place = looked_at(cameras)
    towards = place - np.stack([camera.eye for camera in cameras])
    distance = np.linalg.norm(towards, axis=1)
    along = np.stack([camera.pose[:, 2] for camera in cameras])
    cosine = (along * towards).sum(1) / np.maximum(distance, 1e-30)
    spread = np.linalg.norm(towards - towards.mean(0), axis=1).mean()
    is_around = spread > SPREAD * np.median(distance) and np.linalg.norm(along.mean(0)) < ONE_WAY
    is_ahead = (cosine > 0).mean() >= MOST and np.median(cosine) > np.cos(np.radians(ASIDE))
    return float(np.median(cosine)) if is_around and is_ahead else 0.0


def other_axes(cameras: Sequence[Camera]) -> str | None:
    """The one of AXES by which the cameras would best look at one place from around it. None where
    they do so as they are, or by no other reading.
    """
    if len(cameras) < LEAST_CAMERAS or meeting(cameras):
        return None
    found = {axes: meeting([read_as(one, axes) for one in cameras]) for axes in AXES}
    best = max(found, key=lambda axes: found[axes])
    return best if found[best] else None
