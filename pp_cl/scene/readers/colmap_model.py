"""Cameras and images of a sparse model of COLMAP, text or binary.

Formats: https://colmap.github.io/format.html. Files are read piece by piece and points are passed
over, since they are nearly all of a file.
"""

import os
import struct
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.regular import refusal
from pp_cl.scene.readers.frame import MOST

# id in binary files, number of parameters, of every model of COLMAP that has a focal length
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
    "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EUCM": (16, 6),
}
NAMES = {number: name for name, (number, _) in MODELS.items()}
MOST_PIXELS = 2**20  # a side; beyond it a number is no size
MOST_ENTRIES = 2**17  # of a file, cameras or images
MOST_NAME = 1024  # bytes of an image's name
MOST_LINE = 2**22  # characters of a line: 150,000 2D points
UNKNOWN = "is no known camera model; undistort with `colmap image_undistorter`, or copy it anew"
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
    lenses = _lenses(folder / f"cameras{suffix}", read_cameras)
    file = folder / f"images{suffix}"
    images, names = list(_bounded(file, read_images(file))), set()
    if not images:
        raise UserError(f"{file}: holds no images; run COLMAP's mapper again")
    for image in images:
        if image.camera not in lenses:
            raise UserError(
                f"{file}: {image.name}: its camera {image.camera} is not in cameras{suffix}; copy"
                " both files from one model"
            )
        name = PurePosixPath(image.name)  # ./a.png is a.png
        if name in names:
            raise UserError(f"{file}: {image.name}: stands there twice; remove one")
        names.add(name)
    return lenses, images


def _lenses(file, read):
    """{id: Lens}. Raises UserError for two of one id."""
    lenses = {}
    for identity, lens in _bounded(file, read(file)):
        if identity in lenses:
            raise UserError(f"{file}: camera {identity} stands there twice; remove one")
        lenses[identity] = lens
    return lenses


def _bounded(file, entries):
    """The entries. Raises UserError where they are more than MOST_ENTRIES."""
    for count, entry in enumerate(entries):
        if count == MOST_ENTRIES:
            raise UserError(f"{file}: holds more than {MOST_ENTRIES} entries; split the model")
        yield entry


def is_model(folder: Path, suffix: str) -> bool:
    """True if the folder has cameras and images with this suffix, .bin or .txt."""
    return all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images"))


def _lens(where, model, size, parameters):
    """The Lens. Raises UserError beginning with `where`."""
    if not all(1 <= side < MOST_PIXELS for side in size):
        raise UserError(f"{where}: {size[0]}x{size[1]} pixels is no size; copy the file anew")
    if len(parameters) != MODELS[model][1] or not _are_numbers(parameters):
        raise UserError(
            f"{where}: {model} has {MODELS[model][1]} parameters, finite and not huge; copy the"
            " file anew"
        )
    return Lens(model, *size, tuple(parameters))


def _image(where, name, camera, numbers):
    """The Image; numbers: qw, qx, qy, qz, tx, ty, tz. Raises UserError beginning with `where`."""
    # it goes into messages of one line
    if not 1 <= len(name) <= MOST_NAME or any(
        unicodedata.category(letter) == "Cc" for letter in name
    ):
        raise UserError(f"{where}: {name[:80]!r} is no name of an image; rename it")
    numbers = np.array(numbers, np.float64)
    length = np.linalg.norm(numbers[:4]) if _are_numbers(numbers) else 0
    if abs(length - 1) > 1e-3:
        raise UserError(f"{where}: {name}: its pose is no unit quaternion and place; mend it")
    return Image(name, camera, numbers[:4] / length, numbers[4:])


def _are_numbers(values):
    """Whether all are finite and not huge."""
    return all(abs(value) < MOST for value in values)


# --------------------------------------------------------------------------------------------------


def _lines(file):
    """(number, line) of a text file, one after the other."""
    try:
        with file.open(encoding="utf-8-sig") as opened:
            for number, line in enumerate(iter(lambda: opened.readline(MOST_LINE), ""), 1):
                if len(line) == MOST_LINE:
                    raise UserError(
                        f"{file}: line {number}: is longer than {MOST_LINE} characters; copy it"
                        " anew"
                    )
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
        number, points = next(lines, (number, ""))
        # else an image without its line of points would hide the next one
        if not _is_points(points):
            raise UserError(
                f"{file}: line {number}: must be the 2D points of {name[:80]!r}, X Y POINT3D_ID"
                " each; give every image a second line, empty if it has none"
            )
        yield _image(where, name, camera, numbers)


def _is_points(line):
    words = line.split()
    return len(words) % 3 == 0 and (not words or words[-1].lstrip("-").isdecimal())


# --------------------------------------------------------------------------------------------------


class _Bytes:
    """An opened binary file, read piece by piece; what is beyond its end is a UserError."""

    def __init__(self, file, opened):
        self.file, self.opened = file, opened
        self.size = os.fstat(opened.fileno()).st_size

    def take(self, form):
        """The values of a struct format, little-endian."""
        size = struct.calcsize("<" + form)
        data = self.opened.read(size)
        if len(data) < size:
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

    def end(self):
        at = self.opened.tell()
        if at != self.size:
            raise UserError(
                f"{self.file}: goes on after its last entry, at byte {at}; copy it anew"
            )


@contextmanager
def _opened(file) -> Iterator[_Bytes]:
    try:
        with file.open("rb") as opened:
            yield _Bytes(file, opened)
    except OSError as error:
        raise refusal(file, error, "COLMAP's") from None


def _binary_cameras(file):
    """Each (id, Lens)."""
    with _opened(file) as data:
        (count,) = data.take("Q")
        for _ in range(count):  # a count that is too large ends at the file's end
            identity, number, width, height = data.take("IiQQ")
            where = f"{file}: camera {identity}"
            if number not in NAMES:
                raise UserError(f"{where}: {number} {UNKNOWN}")
            parameters = data.take("d" * MODELS[NAMES[number]][1])
            yield identity, _lens(where, NAMES[number], (width, height), parameters)
        data.end()


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
        data.end()
