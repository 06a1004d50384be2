"""The names, cameras and pixel digests of the training views in a checkpoint: to render without the
scene, and to check that a training resumes with the same photographs.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import View
from pp_cl.errors import listing
from pp_cl.scene.distortion import Distortion
from pp_cl.scene.image_file import Photograph
from pp_cl.scene.readers.common import MOST, numbers

STRAIGHT = Distortion()  # of a lens without distortion
DIGITS = 16  # of a view's digest, hexadecimal: enough to tell pixels that were changed, not forged
POSE, LENS, RANGE = 12, 6, 2  # numbers of a kept view; it may have no depth range
CLOSE = 1e-6  # world units or pixels: cameras are the same
MOST_SIDE = 2**24  # what float32 holds as whole numbers


def pixel_digest(
    image: np.ndarray, distortion: Distortion = STRAIGHT, ignored: np.ndarray | None = None
) -> str:
    """Hex digest of the pixels of a uint8 image, its mask among them, of the distortion that is
    removed from it, and of which pixels are ignored.
    """
    digest = hashlib.sha256(np.ascontiguousarray(image).data)
    digest.update(repr(distortion).encode() if distortion else b"")
    digest.update(b"" if ignored is None else np.packbits(ignored).data)
    return digest.hexdigest()[:DIGITS]


def identity(views: Sequence[View], listed: Sequence[View | Photograph]) -> dict[str, Any]:
    """{"scene": digest of the names and cameras, "pixels": {name: digest} of the views, None where
    the program makes them, "views": for kept_views()}: what the header of a checkpoint holds of its
    training views. listed: those that the scene lists, of which some could not be read.
    """
    made = any(view.digest is None for view in views)
    pixels = None if made else {view.name: view.digest for view in views}
    kept = [[view.name, kept_camera(view.file_camera, view.depth_range)] for view in views]
    return {"scene": fingerprint(listed), "pixels": pixels, "views": kept}


def kept_camera(camera: Camera, depth_range: tuple[float, float] | None = None) -> list[float]:
    """The numbers of a camera and its depth range, which JSON keeps to the bit."""
    lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    return [float(number) for number in (*camera.pose.ravel(), *lens, *(depth_range or ()))]


def kept_views(views: Any) -> list[Photograph]:
    """The training views that identity() has kept. Raises ValueError or TypeError for what it never
    makes.
    """
    if not isinstance(views, list) or not views:
        raise ValueError("no list of views")
    return [_unpacked(*view) for view in views]


def _unpacked(name, stored):
    values = numbers(stored)
    is_list = values is not None and values.ndim == 1
    if type(name) is not str or not is_list or len(values) - (POSE + LENS) not in (0, RANGE):
        raise ValueError("a view without name or camera")
    fx, fy, cx, cy, width, height, *near_far = values[POSE:].tolist()
    pose = values[:POSE].reshape(3, 4)
    is_whole = all(side.is_integer() and 1 <= side <= MOST_SIDE for side in (width, height))
    if not (np.abs(values) < MOST).all() or min(fx, fy) <= 0 or not is_whole:
        raise ValueError("a camera that shows nothing")
    if not np.allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), rtol=0, atol=1e-4):
        raise ValueError("a camera whose axes are not orthonormal")
    camera = Camera(pose, fx, fy, cx, cy, int(width), int(height))
    return Photograph(name, camera, tuple(near_far) or None)


def fingerprint(views: Sequence[View | Photograph]) -> str:
    """Hex digest of the views' names and the cameras of their files."""
    digest = hashlib.sha256()
    for view in views:
        camera = view.camera if isinstance(view, Photograph) else view.file_camera
        digest.update(f"{view.name} {camera.width}x{camera.height} ".encode())
        numbers = np.append(camera.pose.ravel(), [camera.fx, camera.fy, camera.cx, camera.cy])
        digest.update(np.round(numbers, 6).tobytes())
    return digest.hexdigest()


def _are_alike(kept, listed):
    """Whether listed views have the names and, but for rounding, the cameras of kept ones: another
    processor rounds otherwise.
    """
    cameras = {o.name: o.camera if isinstance(o, Photograph) else o.file_camera for o in listed}
    return cameras.keys() == {name for name, _ in kept} and all(
        np.allclose(kept_camera(cameras[name]), numbers[: POSE + LENS], rtol=0, atol=CLOSE)
        for name, numbers in kept
    )


def learned(header: dict[str, Any], listed: Sequence[Photograph]) -> list[Photograph]:
    """Those of the training views that a scene lists without the user's edits that a checkpoint's
    header has: what the scene listed then, if some were dropped or taken back since.
    """
    names = {name for name, _ in header["views"]}
    return [one for one in listed if one.name in names]


def difference(
    header: dict[str, Any], listed: Sequence[View | Photograph], views: Sequence[View]
) -> str:
    """How training views differ from those of a checkpoint's header, in words; "" where they are
    the same.

    listed: all of them; views: those whose pixels are compared, where the header has their digests.
    """
    if fingerprint(listed) != header["scene"] and not _are_alike(header["views"], listed):
        return "its training views have other names or cameras"
    known = header["pixels"] or {}
    changed = [view.name for view in views if view.digest != known.get(view.name, view.digest)]
    return f"{listing(changed)}: other pixels, or another mask" if changed else ""
