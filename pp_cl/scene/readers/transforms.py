"""Reader of scenes in the format of NeRF-synthetic, transforms_<split>.json, extended by
nerfstudio's keys: intrinsics per frame, principal point, near and far.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.image import image_size
from pp_cl.scene.camera import Camera

FILES = "transforms_train.json"

# Lens distortion is not modelled, so its coefficients must be absent or 0.
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# values of camera_model that are pinhole cameras when those coefficients are 0
PINHOLES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")

MOST = 1e30  # larger numbers are refused: float32 could not hold their products
# largest eigenvalue of R^T R - 1 that is taken for rounding; NeRF-synthetic has 1e-6
ROTATION_TOLERANCE = 1e-3
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])  # OpenGL: y up, z backward; OpenCV: y down, z forward


def recognises(folder: Path) -> bool:
    """True if the folder holds a transforms_<split>.json."""
    return any(folder.glob("transforms_*.json"))


def splits(folder: Path) -> list[str]:
    """The names of the splits that the folder holds."""
    return sorted(f.stem.removeprefix("transforms_") for f in folder.glob("transforms_*.json"))


def read_split(folder: Path, split: str) -> list[tuple[str, Camera, tuple[float, float] | None]]:
    """[(image path relative to the folder, Camera, (near, far))] of transforms_<split>.json.

    The last is None for a frame without near and far. Raises UserError naming the file and the key
    that is missing or wrong.
    """
    file = folder / f"transforms_{split}.json"
    if not file.is_file():
        present = ", ".join(splits(folder))
        raise UserError(f"{file}: no such file; the splits of this scene are {present}")
    data = _read_json(file)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{file}: frames: must be a list of one frame or more")
    return [
        _read_frame(folder, _Frame(file, data, frame, index)) for index, frame in enumerate(frames)
    ]


def _read_json(file):
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise UserError(
            f"{file}: line {error.lineno}, column {error.colno}: {error.msg}; correct the JSON"
            " there"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{file}: cannot be read as JSON ({error}); copy it anew") from error
    if not isinstance(data, dict):
        raise UserError(f"{file}: must hold a JSON object with the key frames")
    return data


@dataclass
class _Frame:
    """The keys of one frame; a key that the frame lacks is looked up in the whole file."""

    file: Path
    shared: dict
    own: dict
    index: int

    def __post_init__(self):
        if not isinstance(self.own, dict):
            raise UserError(f"{self.file}: frames[{self.index}]: must be a JSON object")

    def get(self, key):
        """Value of a key; None where it is absent or null."""
        return self.shared.get(key) if self.own.get(key) is None else self.own[key]

    def error(self, key, text):
        """The UserError about a key, which names the file and the frame that the key stands in."""
        here = f"frames[{self.index}]."
        is_shared = key in self.shared and self.own.get(key) is None
        return UserError(f"{self.file}: {'' if is_shared else here}{key}: {text}")

    def number(self, key, above=-math.inf, below=math.inf):
        """Finite float strictly between two bounds, or None if absent."""
        value = self.get(key)
        if value is None:
            return None
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not max(above, -MOST) < value < min(below, MOST):
            bounds = f" above {above:g}" * (above > -math.inf) + f" and below {below:g}" * (
                below < math.inf
            )
            raise self.error(key, f"is {json.dumps(value)[:40]}; must be a finite number{bounds}")
        return float(value)


def _read_frame(folder, frame):
    """(image path relative to the folder, Camera, (near, far) or None) of one frame."""
    name = _image_name(folder, frame)
    width, height = _size(folder, name, frame)
    _refuse_distortion(frame)
    fx, fy = _focal_lengths(frame, width, height)
    cx, cy = frame.number("cx"), frame.number("cy")
    centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    return name, Camera(_pose(frame), fx, fy, *centre, width, height), _depth_range(frame)


def _image_name(folder, frame):
    """Path of the frame's image relative to the folder, which it may not leave, not even by a
    symbolic link.
    """
    given = frame.get("file_path")
    if not isinstance(given, str) or not given:
        raise frame.error("file_path", "must be the path of an image")
    try:
        root = folder.resolve()
        paths = [(root / candidate).resolve() for candidate in (given, given + ".png")]
        if not all(path.is_relative_to(root) for path in paths):
            raise frame.error(
                "file_path", f"{given!r} leaves the scene's folder; move the image into it"
            )
        found = [path for path in paths if path.is_file()]
    # a loop of links, a name too long, a zero byte
    except (OSError, RuntimeError, ValueError) as error:
        raise frame.error("file_path", f"{given[:80]!r} is not a usable path ({error})") from error
    if not found:
        raise frame.error(
            "file_path",
            f"no image at {given!r}, nor with .png added; copy it there or remove the frame",
        )
    return found[0].relative_to(root).as_posix()


def _size(folder, name, frame):
    """(width, height) of the image; w and h must agree, since the other intrinsics are in the same
    pixels.
    """
    size = image_size(folder / name)
    for key, actual in zip(("w", "h"), size, strict=True):
        stated = frame.number(key)
        if stated is not None and stated != actual:
            raise frame.error(
                key,
                f"is {stated:g}, but {name} has {size[0]}x{size[1]} pixels; restore the image's"
                " size, or scale fl_x, fl_y, cx, cy, w and h to it",
            )
    return size


def _refuse_distortion(frame):
    for key in DISTORTION:
        if frame.number(key):
            raise frame.error(
                key,
                "lens distortion is not modelled; undistort the images and leave the"
                " coefficient out",
            )
    model = frame.get("camera_model")
    if model is not None and model not in PINHOLES:
        raise frame.error(
            "camera_model", f"{model!r} is not modelled; undistort the images to PINHOLE"
        )


def _focal_lengths(frame, width, height):
    """(fx, fy) in pixels from fl_x, fl_y or, where these are absent, the angles of view; fy is fx
    if not given.
    """
    fx = _focal_length(frame, "fl_x", "camera_angle_x", width)
    if fx is None:
        raise frame.error("fl_x", "is missing, and so is camera_angle_x; add one of them")
    fy = _focal_length(frame, "fl_y", "camera_angle_y", height)
    return fx, fx if fy is None else fy


def _focal_length(frame, length_key, angle_key, size):
    length, angle = (
        frame.number(length_key, above=0),
        frame.number(angle_key, above=0, below=math.pi),
    )
    if length is None and angle is not None:
        length = 0.5 * size / math.tan(0.5 * angle)
    return length


def _depth_range(frame):
    """(near, far), or None if neither is given."""
    near, far = frame.number("near", above=0), frame.number("far", above=0)
    if near is None and far is None:
        return None
    if near is None or far is None:
        raise frame.error(
            "near" if near is None else "far", "is missing; give both near and far, or neither"
        )
    if far <= near:
        raise frame.error("far", f"is {far:g}; must be above near, {near:g}")
    return near, far


def _pose(frame):
    """(3, 4) camera-to-world, OpenCV axes, of transform_matrix, which has OpenGL's; the rotation is
    made orthonormal.
    """
    key = "transform_matrix"
    try:
        matrix = np.array(frame.get(key), np.float64)
    except (TypeError, ValueError, OverflowError):
        raise frame.error(key, "must be 4x4 or 3x4 numbers") from None
    if matrix.shape not in ((4, 4), (3, 4)):
        raise frame.error(key, f"has shape {matrix.shape}; must be 4x4 or 3x4 numbers")
    if not (np.abs(matrix) < MOST).all():
        raise frame.error(key, "holds NaN, Inf or a huge number; must be a camera-to-world matrix")
    if not np.allclose(matrix[3:], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise frame.error(key, f"its last row is {matrix[3].tolist()}; must be [0, 0, 0, 1]")
    u, scale, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(scale**2 - 1).max() > ROTATION_TOLERANCE or np.linalg.det(u @ vt) < 0:
        raise frame.error(
            key,
            f"its 3x3 part is no rotation (scales {scale.round(4).tolist()}, "
            f"determinant {np.linalg.det(matrix[:3, :3]):.4f}); remove scale, shear and mirroring",
        )
    return np.hstack([u @ vt @ CV_FROM_GL, matrix[:3, 3:]])
