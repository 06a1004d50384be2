"""One frame of a JSON file of cameras: checks its keys and makes a camera from them."""

import math
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.errors import BROKEN_CAMERA, Unusable, UserError, quoted
from pp_cl.scene.lens import LensDistortion
from pp_cl.scene.lookup import Fail, find_image
from pp_cl.scene.readers.common import CUT_UP, MOST, PANORAMIC, numbers

# values of camera_model: perspective lenses, and fisheyes
PINHOLES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
PANORAMAS = ("latlong", "equirectangular")
# keys with which nerfstudio and instant-ngp name lenses, and their supported values; null, false
# and 0 are always supported
LENS_KEYS = {
    "camera_model": PINHOLES + FISHEYES,
    "camera_type": ("PERSPECTIVE",),
    "is_fisheye": ("TRUE", "1"),
    **dict.fromkeys(("ftheta_p0", *PANORAMAS, "orthographic"), ()),
}
CALIBRATE = "undistort the images with the program that found it, or fit the lens without it"
UNDISTORT = "undistort the images to PINHOLE, as `colmap image_undistorter` does"

# largest eigenvalue of R^T R - 1 that counts as rounding; NeRF-synthetic has 1e-6
ROTATION_TOLERANCE = 1e-3
LEAST_ANGLE = 1e-7  # of view, radians: below it, focal lengths are too large for float32
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL: y up, z backward; OpenCV: y down, z forward


@dataclass
class Frame:
    """The keys of one frame in the list `listed`, which go before the keys shared by all."""

    file: Path
    shared: dict
    own: dict
    index: int
    listed: str = "frames"

    def __post_init__(self):
        if not isinstance(self.own, dict):
            raise UserError(f"{self.file}: {self.listed}[{self.index}]: must be a JSON object")

    def get(self, key: str) -> Any:
        """Value of a key; None if it is absent or null."""
        return self.shared.get(key) if self.own.get(key) is None else self.own[key]

    def error(self, key: str, text: str) -> UserError:
        """A UserError about a key, which names the file and the frame that has the key."""
        here = f"{self.listed}[{self.index}]."
        is_shared = key in self.shared and self.own.get(key) is None
        return UserError(f"{self.file}: {'' if is_shared else here}{key}: {text}")

    def number(self, key: str, above: float = -math.inf, below: float = math.inf) -> float | None:
        """A key's finite float, strictly between two bounds, or None if absent. Raises Unusable."""
        value = self.get(key)
        if value is None:
            return None
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not max(above, -MOST) < value < min(below, MOST):
            bounds = f" above {above:g}" if above > -math.inf else ""
            bounds += f" and below {below:g}" if below < math.inf else ""
            text = f"is {quoted(value, 40)}; must be a finite number{bounds}"
            raise Unusable(self.error(key, text), BROKEN_CAMERA)
        return float(value)

    def array(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """A key's finite float64 array of a shape. Raises Unusable if it is absent or different."""
        array = numbers(self.get(key), shape)
        if array is None:
            text = f"must be {'x'.join(map(str, shape))} finite numbers"
            raise Unusable(self.error(key, text), BROKEN_CAMERA)
        return array

    def image(self, key: str, folder: Path) -> str | None:
        """find_image() for the path that a key holds; None if it is absent. Raises UserError."""
        path = self.get(key)
        kind = "mask" if key == "mask_path" else "image"
        if path is None:
            return None
        if not isinstance(path, str) or not path:
            raise Unusable(self.error(key, "must be the path of an image"), f"no {kind}")
        return find_image(folder, path, partial(self.error, key), kind)


def frame_keys(camera: Camera) -> dict[str, Any]:
    """A camera in the format of nerfstudio's transforms files, which pinhole() reads."""
    pose = np.vstack([camera.pose, [0, 0, 0, 1]]) @ GL_FROM_CV
    return {
        "transform_matrix": pose.tolist(),
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }


def pinhole(frame: Frame, width: int, height: int) -> Camera:
    """The camera of a frame in NeRF-synthetic's or nerfstudio's format, for an image of width x
    height pixels. Raises UserError naming the missing or wrong key.
    """
    fx = _focal_length(frame, "fl_x", "camera_angle_x", width)
    if fx is None:
        raise frame.error("fl_x", "is missing, and so is camera_angle_x; add one of them")
    fy = _focal_length(frame, "fl_y", "camera_angle_y", height)
    cx, cy, key = frame.number("cx"), frame.number("cy"), "transform_matrix"
    return Camera(
        rigid(frame.get(key), partial(frame.error, key)) @ GL_FROM_CV,
        fx,
        fx if fy is None else fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        width,
        height,
    )


def _focal_length(frame, length_key, angle_key, size):
    """The focal length in pixels, from its key or the angle of view's; None if both are absent."""
    length = frame.number(length_key, above=0)
    angle = frame.number(angle_key, above=LEAST_ANGLE, below=math.pi)
    if length is None and angle is not None:
        length = 0.5 * size / math.tan(0.5 * angle)
    return length


def lens_distortion(frame: Frame) -> LensDistortion:
    """The lens distortion of a frame in nerfstudio's or instant-ngp's format. Raises UserError for
    a lens other than OpenCV's perspective and fisheye ones.
    """
    for key, known in LENS_KEYS.items():
        value = frame.get(key)
        if value and (key in PANORAMAS or str(value).upper() == PANORAMIC):
            raise frame.error(key, CUT_UP)
        if value and str(value).upper() not in known:
            raise frame.error(key, f"{quoted(value, 40)} is not modelled; {UNDISTORT}")
    is_fisheye = bool(frame.get("is_fisheye"))
    is_fisheye |= str(frame.get("camera_model")).upper() in FISHEYES
    for key in ("p1", "p2") if is_fisheye else ("k4",):
        if frame.number(key):
            raise frame.error(key, f"is not modelled with this lens; {CALIBRATE}")
    numbers = {key: frame.number(key) or 0.0 for key in ("k1", "k2", "p1", "p2", "k3", "k4")}
    return LensDistortion(**numbers, fisheye=is_fisheye)


def rigid(value: Any, fail: Fail) -> np.ndarray:
    """(3, 4) float64 pose from a 4x4 or 3x4 matrix, with orthonormal axes and without the scale
    that all axes share; left-handed axes stay so. Raises Unusable with the text of fail().
    """
    matrix = numbers(value, (4, 4))
    if matrix is None:
        matrix = numbers(value, (3, 4))
    if matrix is None:
        raise Unusable(fail("must be 4x4 or 3x4 finite numbers, camera-to-world"), "no pose")
    if len(matrix) == 4 and matrix[:, 3].tolist() == [0, 0, 0, 1] != matrix[3].tolist():
        what = "matrices are read column by column, as their last column is 0 0 0 1"
        warnings.warn(what, stacklevel=1)
        matrix = matrix.T
    if np.abs(matrix[3:] - [0, 0, 0, 1]).max(initial=0) > 1e-6:
        text = f"its last row is {matrix[3].tolist()}; must be [0, 0, 0, 1]"
        raise Unusable(fail(text), "no pose")
    u, scale, vt = np.linalg.svd(matrix[:3, :3])
    alike = np.abs((scale / max(scale.mean(), 1 / MOST)) ** 2 - 1).max() <= ROTATION_TOLERANCE
    if not alike:
        text = f"its 3x3 part is no rotation (scales {scale.round(4).tolist()}); remove the shear"
        raise Unusable(fail(text), "no pose")
    return np.hstack([u @ vt, matrix[:3, 3:]])
