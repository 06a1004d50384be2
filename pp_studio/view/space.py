"""Converts cameras and positions between a run or scene and its page."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image
from scipy.spatial.transform import Rotation

from pp_cl import Camera

FARTHEST = 1e6  # farthest distance of an eye from the page's origin, in the page's units
FRUSTUM = 0.3  # length of a frustum, in the page's units
VIEW, CHOSEN = (61, 127, 216), (255, 138, 31)  # colours of frustums
THUMBNAIL = 256  # pixels on the longer side


class Space(NamedTuple):
    """The coordinates of a page: positions in the world minus `centre` (3,), divided by `radius`.
    All scenes thus have one size there, for which float32 is fine enough. The axes are the world's.
    """

    centre: np.ndarray
    radius: float

    def page(self, positions: ArrayLike) -> np.ndarray:
        """(..., 3) in the page's coordinates."""
        return (np.asarray(positions) - self.centre) / self.radius

    def world(self, positions: ArrayLike) -> np.ndarray:
        """(..., 3) in the world's coordinates."""
        return np.asarray(positions) * self.radius + self.centre

    def camera(self, seen: Any) -> Camera | None:
        """The camera of a tab, with the tab's pixels; None if the numbers are not a camera's. seen:
        viser's CameraHandle.
        """
        width, height, fov = seen.image_width, seen.image_height, seen.fov
        place = [*seen.wxyz, *seen.position]
        if not (np.isfinite(place).all() and np.abs(place).max() < FARTHEST and any(seen.wxyz)):
            return None
        if not (1e-3 < fov < 3 and 0 < width < 1e5 and 0 < height < 1e5):
            return None
        axes = Rotation.from_quat(np.roll(seen.wxyz, -1)).as_matrix()  # OpenCV's axes, as ours
        pose = np.column_stack([axes, self.world(seen.position)])
        focal = height / 2 / math.tan(fov / 2)
        return Camera(pose, focal, focal, width / 2, height / 2, width, height)

    def look_through(self, camera: Camera, seen: Any) -> None:
        """Move a tab's CameraHandle or an initial_camera to a camera, but upright. It then turns
        around the point of the camera's axis that is nearest to the page's origin.
        """
        eye, forward = self.page(camera.eye), camera.pose[:, 2]
        seen.position = eye
        seen.look_at = eye + max(-eye @ forward, 0.1) * forward
        seen.fov = 2 * math.atan(camera.height / 2 / camera.fy)

    def add_frustum(self, server: Any, name: str, camera: Camera, **options: Any) -> Any:
        """Add a camera's frustum, FRUSTUM long; its handle. options: of add_camera_frustum()."""
        x, y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
        return server.scene.add_camera_frustum(
            name,
            fov=2 * math.atan(y),
            aspect=x / y,
            scale=FRUSTUM * (x * y / 3) ** (1 / 3),  # viser scales all to one volume
            thickness=1.5,
            thickness_units="screen",
            wxyz=np.roll(Rotation.from_matrix(camera.pose[:, :3]).as_quat(), 1),
            position=self.page(camera.eye),
            **{"color": VIEW} | options,
        )


def thumbnail(image: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 thumbnail of straight RGBA (H, W, 4), reduced and over white."""
    small = Image.fromarray(image)
    small.thumbnail((THUMBNAIL, THUMBNAIL))
    white = Image.new("RGBA", small.size, "white")
    return np.asarray(Image.alpha_composite(white, small).convert("RGB"))
