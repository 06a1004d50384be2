"""The names, cameras and pixel digests of the training views in a checkpoint, with which pp-cl
renders without the scene and checks that a training resumes with the same images.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import View
from pp_cl.errors import few_names
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.readers.common import MOST, numbers

POSE, LENS, RANGE = 12, 6, 2  # numbers of a stored view, which may lack the depth range
CLOSE = 1e-6  # world units or pixels: a smaller difference is another processor's rounding
MOST_SIDE = 2**24  # float32 holds whole numbers up to this


def identity(views: Sequence[View]) -> dict[str, Any]:
    """Entries of a checkpoint's header: "pixels": {name: digest} of the views, None if the program
    makes the images; "views": the list that unpacked_views() reads.
    """
    made = any(view.digest is None for view in views)
    pixels = None if made else {view.name: view.digest for view in views}
    packed = [[view.name, packed_camera(view.file_camera, view.depth_range)] for view in views]
    return {"pixels": pixels, "views": packed}


def packed_camera(camera: Camera, depth_range: tuple[float, float] | None = None) -> list[float]:
    """The numbers of a camera and its depth range, which JSON stores exactly."""
    lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    return [float(number) for number in (*camera.pose.ravel(), *lens, *(depth_range or ()))]


def unpacked_views(views: Any) -> list[ImageFile]:
    """The training views that identity() stored. Raises ValueError or TypeError."""
    if not isinstance(views, list) or not views:
        raise ValueError("no list of views")
    return [_unpacked(*view) for view in views]


def _unpacked(name, stored):
    values = numbers(stored)
    shapes = (POSE + LENS,), (POSE + LENS + RANGE,)
    if type(name) is not str or values is None or values.shape not in shapes:
        raise ValueError("a view without name or camera")
    fx, fy, cx, cy, width, height, *near_far = values[POSE:].tolist()
    pose = values[:POSE].reshape(3, 4)
    is_whole = all(side.is_integer() and 1 <= side <= MOST_SIDE for side in (width, height))
    if not (np.abs(values) < MOST).all() or min(fx, fy) <= 0 or not is_whole:
        raise ValueError("a camera that shows nothing")
    if not np.allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), rtol=0, atol=1e-4):
        raise ValueError("a camera whose axes are not orthonormal")
    camera = Camera(pose, fx, fy, cx, cy, int(width), int(height))
    return ImageFile(name, camera, tuple(near_far) or None)


def difference(
    header: dict[str, Any], listed: Sequence[ImageFile], views: Sequence[View] = ()
) -> str:
    """How the training views of a checkpoint's header differ from those that a scene lists; "" if
    all are listed with the same cameras. views: views whose pixels are compared, too.
    """
    cameras = {image_file.name: packed_camera(image_file.camera) for image_file in listed}
    for name, packed in header["views"]:
        now = cameras.get(name)
        if now is None or not np.allclose(now, packed[: POSE + LENS], rtol=0, atol=CLOSE):
            return "its training views have other names or cameras"
    known = header["pixels"] or {}
    changed = [view.name for view in views if view.digest != known.get(view.name, view.digest)]
    return f"{few_names(changed)}: other pixels, or another mask" if changed else ""
