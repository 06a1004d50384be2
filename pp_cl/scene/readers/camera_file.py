"""Reads cameras without images from a file of another program: nerfstudio's camera_path.json, a
transforms.json, or the cameras.json of 3D Gaussian Splatting and brush.
"""

import math
import warnings
from functools import partial
from pathlib import Path

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.scene.readers.common import read_json
from pp_cl.scene.readers.frame import (
    GL_FROM_CV,
    LEAST_ANGLE,
    Frame,
    lens_distortion,
    pinhole,
    rigid,
)

FORMATS = (
    "a camera_path.json (with camera_path), a transforms.json (with frames), or a cameras.json (a"
    " list)"
)
MOST_RATE = 240  # frames a second
MOST_PIXELS = 2**15  # a side; the pixel boxes of points are 16-bit


def read_cameras(file: Path, size: tuple[int, int] | None = None) -> list[Camera]:
    """The cameras of a file, in its order and world.

    size: (width, height) of frames that state none. Raises UserError naming the file and the
    missing or wrong key.
    """
    if not file.is_file():
        raise UserError(f"{file}: no such file; give orbit, spiral, a split, or {FORMATS}")
    data = read_json(file)
    if isinstance(data, list):
        read, frames, listed, shared = _splatting_camera, data, "", {}
    elif isinstance(data, dict) and "camera_path" in data:
        read, frames, listed, shared = _path_camera, data["camera_path"], "camera_path", data
    elif isinstance(data, dict) and "frames" in data:
        read, frames, listed, shared = _transforms_camera, data["frames"], "frames", data
    else:
        raise UserError(f"{file}: holds no cameras; give {FORMATS}")
    if shared.get("crop"):
        warnings.warn(f"{file}: its crop is not read; all of the object is drawn", stacklevel=2)
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{file}: {listed or 'the list'}: must hold at least one camera")
    cameras = [read(Frame(file, shared, own, i, listed), size) for i, own in enumerate(frames)]
    for i, camera in enumerate(cameras):
        if np.linalg.det(camera.pose[:, :3]) < 0:
            raise UserError(f"{file}: {listed}[{i}]: its axes are left-handed; mirror them back")
    return cameras


def read_rate(file: Path) -> float | None:
    """The frames per second that a camera_path.json states; None if the file states none. Raises
    UserError for a file that cannot be read.
    """
    data = read_json(file) if file.is_file() else None
    rate = data.get("fps") if isinstance(data, dict) and "camera_path" in data else None
    return float(rate) if isinstance(rate, (int, float)) and 0 < rate <= MOST_RATE else None


def _transforms_camera(frame, size):
    lens_distortion(frame)  # refuses unknown models; a rendering has no distortion
    return pinhole(frame, *_size(frame, ("w", "h"), size))


def _path_camera(frame, size):
    """The Camera of a frame of nerfstudio's viewer; fov is the angle across the height, degrees."""
    if frame.get("camera_type") not in (None, "perspective"):
        raise frame.error("camera_type", "must be perspective; change it, and fov with it")
    width, height = _size(frame, ("render_width", "render_height"), size)
    fov = frame.number("fov", above=math.degrees(LEAST_ANGLE), below=180)
    if fov is None:
        raise frame.error("fov", "is missing; add the angle across the height in degrees")
    matrix = frame.get("camera_to_world")
    if isinstance(matrix, list) and len(matrix) == 16:
        matrix = [matrix[row : row + 4] for row in range(0, 16, 4)]
    pose = rigid(matrix, partial(frame.error, "camera_to_world")) @ GL_FROM_CV
    focal = 0.5 * height / math.tan(math.radians(fov) / 2)
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def _splatting_camera(frame, size):
    """The Camera of a frame with a camera-to-world rotation, OpenCV's axes, and a position."""
    width, height = _size(frame, ("width", "height"), size)
    matrix = np.column_stack([frame.array("rotation", (3, 3)), frame.array("position", (3,))])
    pose = rigid(matrix, partial(frame.error, "rotation"))
    fx, fy = (frame.number(key, above=0) for key in ("fx", "fy"))
    if fx is None:
        raise frame.error("fx", "is missing; add the focal length in pixels")
    return Camera(pose, fx, fx if fy is None else fy, width / 2, height / 2, width, height)


def _size(frame, keys, size):
    """(width, height) in whole pixels that the frame states, or else the given one."""
    stated = [frame.number(key, above=0, below=MOST_PIXELS) for key in keys]
    if None in stated:
        if size is None:
            raise frame.error(keys[stated.index(None)], "is missing; add it, or give --size WxH")
        return size
    return tuple(max(1, round(side)) for side in stated)
