"""What the cameras of a scene have in common."""

from collections.abc import Sequence

import numpy as np

from pp_cl.scene.camera import Camera

# of the cameras' mean up against the levelness of their horizons: only decides where these do not
MEAN_UP = 1e-6


def looked_at(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) the world position nearest to the optical axes of all cameras, by least squares."""
    forward = np.stack([camera.pose[:, 2] for camera in cameras])
    eyes = np.stack([camera.eye for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (N, 3, 3) projectors
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, eyes), rcond=1e-9)[0]


def estimated_up(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) unit vector: the world direction that is most nearly perpendicular to the x axes of all
    cameras, as photographers hold them level, on the side of their mean up.
    """
    right = np.stack([camera.pose[:, 0] for camera in cameras])
    mean_up = -np.mean([camera.pose[:, 1] for camera in cameras], axis=0)
    tilt = right.T @ right / len(cameras) - MEAN_UP * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(tilt)[1][:, 0]  # of the smallest eigenvalue
    return up if up @ mean_up >= 0 else -up
