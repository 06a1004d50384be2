"""Where the cameras of images look, and what is up in them."""

from collections.abc import Sequence

import numpy as np

from pp_cl.engine.camera import Camera


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
