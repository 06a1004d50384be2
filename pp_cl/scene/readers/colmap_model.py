"""Cameras and images of a sparse model of COLMAP, text or binary.

Formats: https://colmap.github.io/format.html. Files are read piece by piece and points are passed
over, since they are nearly all of a file.
"""

import os
import struct
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.untrusted import refusal
from pp_cl.scene.readers.common import MOST

# number of parameters of every model of COLMAP that has a focal length, in the order of their ids
MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
}
MOST_PIXELS = 2**20  # a side; beyond it a number is no size
MOST_ENTRIES = 2**17  # of a file, cameras or images
MOST_NAME = 1024  # bytes of an image's name
MOST_LINE = 2**22  # characters of a line: 150,000 2D points
UNKNOWN = "is no known camera model; undistort with `colmap image_undistorter`, or copy it anew"
POINT2D_BYTES = 24  # x, y and the id of a 3D point


class Lens(NamedTuple):
    """A camera of the model. parameters: as COLMAP orders them for this model."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class Image(NamedTuple):
    """An image of the model. rotation: (w, x, y, z) of a unit quaternion, world to camera."""

    name: str
    camera: int
    rotation: np.ndarray
    translation: np.ndarray


def is_model(folder: Path, suffix: str) -> bool:
    """True if the folder has cameras and images with this suffix, .bin or .txt."""
    return all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images"))


def read_model(folder: Path) -> tuple[dict[int, Lens], list[Image]]:
    """(cameras by id, images) of the model in a folder; binary files go before text. Raises
    UserError naming the file, and the line or the place in it.
    """
    suffix = ".bin" if is_model(folder, ".bin") else ".txt"
    read_cameras, read_images = (
        (_binary_cameras, _binary_images) if suffix == ".bin" else (_text_cameras, _text_images)
    )
    lenses, images, names = {}, [], set()
    file = folder / f"cameras{suffix}"
    for identity, lens in _bounded(file, read_cameras):
        if identity in lenses:
            raise UserError(f"{file}: camera {identity} stands there twice; remove one")
        lenses[identity] = lens
    file = folder / f"images{suffix}"
    for image in _bounded(file, read_images):
        if image.camera not in lenses:
            raise UserError(
                f"{file}: {image.name}: its camera {image.camera} is not in cameras{suffix}; copy"
                " both files from one model"
            )
        name = PurePosixPath(image.name)  # ./a.png is a.png
        if name in names:
            raise UserError(f"{file}: {image.name}: stands there twice; remove one")
        names.add(name)
        images.append(image)
    if not images:
        raise UserError(f"{file}: holds no images; run COLMAP's mapper again")
    return lenses, images


def _bounded(file, read):
    """The entries of a file. Raises UserError where they are more than MOST_ENTRIES."""
    for count, entry in enumerate(read(file)):
        if count == MOST_ENTRIES:
            raise UserError(f"{file}: holds more than {MOST_ENTRIES} entries; split the model")
        yield entry


def _lens(where, model, size, parameters):
    """The Lens. Raises UserError beginning with `where`."""
    if not all(1 <= side < MOST_PIXELS for side in size):
        raise UserError(f"{where}: {size[0]}x{size[1]} pixels is no size; copy the file anew")
    if len(parameters) != MODELS[model] or not _are_numbers(parameters):
        raise UserError(
            f"{where}: {model} has {MODELS[model]} parameters, finite and not huge; copy the file"
            " anew"
        )
    return Lens(model, *size, tuple(parameters))


def _image(where, name, camera, numbers):
    """The Image; numbers: qw, qx, qy, qz, tx, ty, tz. Raises UserError beginning with `where`."""
    # the name goes into messages of one line
    has_controls = any(unicodedata.category(letter) == "Cc" for letter in name)
    if has_controls or not 1 <= len(name) <= MOST_NAME:
        raise UserError(f"{where}: {name[:80]!r} is no name of an image; rename it")
    numbers = np.array(numbers, np.float64)
    length = np.linalg.norm(numbers[:4]) if _are_numbers(numbers) else 0
    if abs(length - 1) > 1e-3:
        raise UserError(f"{where}: {name}: its pose is no unit quaternion and place; mend it")
    return Image(name, camera, numbers[:4] / length, numbers[4:])


def _are_numbers(values):
    """Whether all are finite and not huge."""
    return all(abs(value) < MOST for value in values)


# Text ---------------------------------------------------------------------------------------------


def _lines(file):
    """(number, line) of a text file, one after the other."""
    try:
        with file.open(encoding="utf-8-sig") as opened:
            for number, line in enumerate(iter(lambda: opened.readline(MOST_LINE), ""), 1):
                if len(line) == MOST_LINE:
                    raise ValueError(f"line {number} has {MOST_LINE} characters or more")
                yield number, line.strip()
    except (OSError, ValueError) as error:
        raise refusal(file, error, "text") from None


def _text_cameras(file):
    """Each (id, Lens)."""
    for number, line in _lines(file):
        if not line or line.startswith("#"):
            continue
        where, words = f"{file}: line {number}", line.split()
        try:
            identity, model, size = int(words[0]), words[1], (int(words[2]), int(words[3]))
            parameters = [float(word) for word in words[4:]]
        except (IndexError, ValueError, OverflowError):
            raise UserError(
                f"{where}: is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; copy the file anew"
            ) from None
        if model not in MODELS:
            raise UserError(f"{where}: {model[:40]!r} {UNKNOWN}")
        yield identity, _lens(where, model, size, parameters)


def _text_images(file):
    """Each Image; it has two lines, of which the second, its 2D points, may be empty."""
    lines = _lines(file)
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        where, words = f"{file}: line {number}", line.split(maxsplit=9)
        try:
            numbers, camera, name = [float(w) for w in words[1:8]], int(words[8]), words[9]
        except (IndexError, ValueError, OverflowError):
            raise UserError(
                f"{where}: is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; copy the file anew"
            ) from None
        number, line = next(lines, (number, ""))
        points = line.split()
        # else an image without its line of points would hide the next one
        if len(points) % 3 or (points and not points[-1].lstrip("-").isdecimal()):
            raise UserError(
                f"{file}: line {number}: must be the 2D points of {name[:80]!r}, X Y POINT3D_ID"
                " each; give every image a second line, empty if it has none"
            )
        yield _image(where, name, camera, numbers)


# Binary -------------------------------------------------------------------------------------------


class _Bytes:
    """An opened binary file, read piece by piece; what is beyond its end is a UserError."""

    def __init__(self, file, opened):
        self.file, self.opened = file, opened
        self.size = os.fstat(opened.fileno()).st_size

    def take(self, form):
        """The values of a struct format, little-endian."""
        data = self.opened.read(struct.calcsize("<" + form))
        if len(data) < struct.calcsize("<" + form):
            raise self.too_short()
        return struct.unpack("<" + form, data)

    def skip(self, size):
        if size > self.size - self.opened.tell():
            raise self.too_short()
        self.opened.seek(size, os.SEEK_CUR)

    def too_short(self):
        return UserError(f"{self.file}: ends at byte {self.size}, too early; copy it anew")

    def name(self):
        at = self.opened.tell()
        text, end, _ = self.opened.read(MOST_NAME).partition(b"\0")
        if not end:
            raise UserError(f"{self.file}: byte {at}: a name does not end; copy it anew")
        self.opened.seek(at + len(text) + 1)
        try:
            return text.decode()
        except UnicodeDecodeError:
            raise UserError(f"{self.file}: byte {at}: a name is not UTF-8; rename it") from None


@contextmanager
def _opened(file) -> Iterator[_Bytes]:
    """The file, which must be at its end when the block ends."""
    try:
        with file.open("rb") as opened:
            data = _Bytes(file, opened)
            yield data
            if opened.tell() != data.size:
                raise UserError(
                    f"{file}: goes on after its last entry, at byte {opened.tell()}; copy it anew"
                )
    except OSError as error:
        raise refusal(file, error, "COLMAP's") from None


def _binary_cameras(file):
    """Each (id, Lens)."""
    names = dict(enumerate(MODELS))
    with _opened(file) as data:
        (count,) = data.take("Q")
        for _ in range(count):  # a count that is too large ends at the file's end
            identity, number, width, height = data.take("IiQQ")
            where = f"{file}: camera {identity}"
            if number not in names:
                raise UserError(f"{where}: {number} {UNKNOWN}")
            parameters = data.take("d" * MODELS[names[number]])
            yield identity, _lens(where, names[number], (width, height), parameters)


def _binary_images(file):
    """Each Image."""
    with _opened(file) as data:
        (count,) = data.take("Q")
        for _ in range(count):
            identity, *numbers, camera = data.take("IdddddddI")
            name = data.name()
            (points,) = data.take("Q")
            data.skip(points * POINT2D_BYTES)
            yield _image(f"{file}: image {identity}", name, camera, numbers)
