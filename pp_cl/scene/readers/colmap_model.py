"""Cameras and images of a sparse model of COLMAP, text or binary.

Formats: https://colmap.github.io/format.html. Of points only the number is looked at.
"""

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError

# id in binary files, number of parameters, of every model that COLMAP has
MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "FOV": (7, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "THIN_PRISM_FISHEYE": (10, 12),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),
}
NAMES = {number: name for name, (number, _) in MODELS.items()}
MOST_PIXELS = 2**20  # a side; beyond it a number is no size
MOST_NAME = 4096  # bytes of an image's name
POINT2D_BYTES = 24  # x, y and the id of a 3D point


@dataclass(frozen=True)
class Lens:
    """A camera of the model. parameters: as COLMAP orders them for this model."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class Image:
    """An image of the model. rotation: (w, x, y, z) of a unit quaternion, world to camera."""

    name: str
    camera: int
    rotation: np.ndarray
    translation: np.ndarray


def read_model(folder: Path) -> tuple[dict[int, Lens], list[Image]]:
    """(cameras by id, images) of the model in a folder; binary files go before text. Raises
    UserError naming the file, and the line or the place in it.
    """
    suffix = ".bin" if is_model(folder, ".bin") else ".txt"
    read_cameras, read_images = (
        (_binary_cameras, _binary_images) if suffix == ".bin" else (_text_cameras, _text_images)
    )
    file = folder / f"images{suffix}"
    lenses, images = read_cameras(folder / f"cameras{suffix}"), read_images(file)
    if not images:
        raise UserError(f"{file}: holds no images; run COLMAP's mapper again")
    names = set()
    for image in images:
        if image.camera not in lenses:
            raise UserError(
                f"{file}: {image.name}: its camera {image.camera} is not in cameras{suffix}; copy"
                " both files from one model"
            )
        if image.name in names:
            raise UserError(f"{file}: {image.name}: stands there twice; remove one")
        names.add(image.name)
    return lenses, images


def is_model(folder: Path, suffix: str) -> bool:
    """True if the folder has cameras and images with this suffix, .bin or .txt."""
    return all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images"))


def _lens(where, model, size, parameters):
    """The Lens. Raises UserError beginning with `where`."""
    if not all(1 <= side < MOST_PIXELS for side in size):
        raise UserError(f"{where}: {size[0]}x{size[1]} pixels is no size; copy the file anew")
    if len(parameters) != MODELS[model][1] or not all(map(math.isfinite, parameters)):
        raise UserError(
            f"{where}: {model} has {MODELS[model][1]} finite parameters; copy the file anew"
        )
    return Lens(model, *size, tuple(parameters))


def _image(where, name, camera, numbers):
    """The Image; numbers: qw, qx, qy, qz, tx, ty, tz. Raises UserError beginning with `where`."""
    numbers = np.array(numbers, np.float64)
    length = np.linalg.norm(numbers[:4])
    if not np.isfinite(numbers).all() or abs(length - 1) > 1e-3:
        raise UserError(f"{where}: {name}: its pose is no unit quaternion and place; mend it")
    return Image(name, camera, numbers[:4] / length, numbers[4:])


# --------------------------------------------------------------------------------------------------


def _lines(file):
    """[(number, line)] of a text file that are no comments."""
    try:
        text = file.read_text("utf-8")
    except (OSError, ValueError) as error:
        raise UserError(f"{file}: cannot be read as text ({error}); copy it anew") from None
    lines = enumerate(text.split("\n"), 1)
    return [(number, line) for number, line in lines if not line.startswith("#")]


def _text_cameras(file):
    lenses = {}
    for number, line in _lines(file):
        if not line.strip():
            continue
        where, words = f"{file}: line {number}", line.split()
        try:
            identity, model, size = int(words[0]), words[1], (int(words[2]), int(words[3]))
            parameters = [float(word) for word in words[4:]]
        except (IndexError, ValueError, OverflowError):
            raise UserError(f"{where}: is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from None
        if model not in MODELS:
            raise UserError(f"{where}: {model[:40]!r} is no camera model of COLMAP's")
        lenses[identity] = _lens(where, model, size, parameters)
    return lenses


def _text_images(file):
    """Each image has two lines, of which the second, its 2D points, may be empty."""
    images, lines = [], _lines(file)
    while lines and not lines[-1][1].strip():
        lines.pop()
    for number, line in lines[::2]:
        where, words = f"{file}: line {number}", line.split(maxsplit=9)
        try:
            numbers, camera, name = [float(w) for w in words[1:8]], int(words[8]), words[9].strip()
        except (IndexError, ValueError, OverflowError):
            raise UserError(
                f"{where}: is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            ) from None
        images.append(_image(where, name, camera, numbers))
    return images


# --------------------------------------------------------------------------------------------------


class _Bytes:
    """A binary file, read piece by piece; what is beyond its end is a UserError."""

    def __init__(self, file):
        self.file, self.at = file, 0
        try:
            self.data = file.read_bytes()
        except OSError as error:
            raise UserError(f"{file}: cannot be read ({error.strerror}); copy it anew") from None

    def take(self, form):
        """The values of a struct format, little-endian."""
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.data, self.at - size)

    def skip(self, size):
        if size > len(self.data) - self.at:
            raise UserError(f"{self.file}: ends at byte {len(self.data)}, too early; copy it anew")
        self.at += size

    def name(self):
        end = self.data.find(b"\0", self.at, self.at + MOST_NAME)
        if end < 0:
            raise UserError(f"{self.file}: byte {self.at}: a name does not end; copy it anew")
        text, self.at = self.data[self.at : end], end + 1
        try:
            return text.decode()
        except UnicodeDecodeError:
            raise UserError(
                f"{self.file}: byte {self.at}: a name is not UTF-8; rename it"
            ) from None

    def end(self):
        if self.at != len(self.data):
            raise UserError(
                f"{self.file}: goes on after its last entry, at byte {self.at}; copy it anew"
            )


def _binary_cameras(file):
    data, lenses = _Bytes(file), {}
    (count,) = data.take("Q")
    for _ in range(count):  # a count that is too large ends at the file's end
        identity, number, width, height = data.take("IiQQ")
        where = f"{file}: camera {identity}"
        if number not in NAMES:
            raise UserError(f"{where}: {number} is no camera model of COLMAP's; copy it anew")
        parameters = data.take("d" * MODELS[NAMES[number]][1])
        lenses[identity] = _lens(where, NAMES[number], (width, height), parameters)
    data.end()
    return lenses


def _binary_images(file):
    data, images = _Bytes(file), []
    (count,) = data.take("Q")
    for _ in range(count):
        identity, *numbers, camera = data.take("IdddddddI")
        name = data.name()
        (points,) = data.take("Q")
        data.skip(points * POINT2D_BYTES)
        images.append(_image(f"{file}: image {identity}", name, camera, numbers))
    data.end()
    return images
