"""Reader of COLMAP's sparse models: cameras and images, text or binary, beside a folder of images
and, for objects, one of masks.

Formats: https://colmap.github.io/format.html. Files are read piece by piece and points are passed
over, since they are nearly all of a file.
"""

import os
import struct
import unicodedata
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl.engine.camera import Camera
from pp_cl.errors import BROKEN_CAMERA, Unusable, UserError
from pp_cl.files.image import image_size
from pp_cl.files.untrusted import opened_regular, refusal
from pp_cl.scene.distortion import Distortion
from pp_cl.scene.found import LeftOut, find_image, folder_named, holds_images, usable
from pp_cl.scene.image_file import Photograph
from pp_cl.scene.readers.common import (
    MOST,
    fail_at,
    fitted,
    hold_out,
    progress,
    two_splits,
)

FILES = "a sparse model of COLMAP beside images"
# and in numbered folders in them; the folder itself has the model of RealityScan
PLACES = ("sparse", "colmap/sparse", "dense/sparse", "dense/0/sparse", ".")
IMAGES = "images"

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
# those that are read: with one focal length, with two
ONE_FOCAL = (
    *("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"),
    *("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
)
TWO_FOCALS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "FISHEYE", "OPENCV_FISHEYE")
MOST_PIXELS = 2**20  # a side; beyond it a number is no size
MOST_ENTRIES = 2**17  # of a file, cameras or images
MOST_NAME = 1024  # bytes of an image's name
MOST_LINE = 2**22  # characters of a line: 150,000 2D points
PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP
UNKNOWN = "is no known camera model; undistort with `colmap image_undistorter`, or copy it again"
POINT2D_BYTES = 24  # x, y and the id of a 3D point
TRACK_BYTES = 8  # the ids of an image and of a point in it


class Lens(NamedTuple):
    """A camera of the model. parameters: as COLMAP orders them for this model."""

    model: str
    width: int
    height: int
    parameters: Sequence[float]


class Image(NamedTuple):
    """An image of the model. pose: (7,) qw, qx, qy, qz, tx, ty, tz, world to camera, as the file
    has it.
    """

    name: str
    camera: int
    pose: Sequence[float]


splits = two_splits


def recognises(folder: Path) -> bool:
    """True if the folder has a model in one of the usual places."""
    return bool(_models(folder))


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[Photograph]:
    """The photographs of a split: test is every eighth in the order of their names.

    Where images were reduced or enlarged after COLMAP saw them, their cameras are scaled to them.
    Raises UserError naming the file, and the image.
    """
    model = model_folder(folder) or folder
    if (count := len(_models(folder))) > 1:
        text = f"of {count} models the largest beside images is read ({model})"
        warnings.warn(f"{folder}: {text}", stacklevel=1)
    lenses, images = read_model(model)
    for lens in lenses.values():
        if isinstance(lens, Lens) and lens.model not in ONE_FOCAL + TWO_FOCALS:
            raise UserError(
                f"{model}: camera model {lens.model} is not read; convert with `colmap"
                f" image_undistorter --image_path {folder / IMAGES} --input_path {model}"
                " --output_path NEW` and give NEW"
            )
    chosen = hold_out(sorted(images, key=lambda image: image.name), split)
    near = _images_of(folder, model) or folder / IMAGES
    read = partial(_photograph, folder, near.relative_to(folder).as_posix(), model, lenses)
    return list(usable(progress(chosen), read, lambda image: image.name, left_out))


def model_folder(folder: Path) -> Path | None:
    """Where a scene's model lies, of several that with most images, those first that have a folder
    of images beside or above them; None where it has none.
    """
    models = _models(folder)
    if len(models) < 2:
        return next(iter(models), None)
    return max(models, key=lambda model: (_images_of(folder, model) is not None, _count(model)))


def _images_of(folder, model):
    """The folder of images nearest to a model, up to the scene's folder: an undistorted model has
    other images than the one that it was made of. None where there is none.
    """
    places = [model, *model.parents]
    for place in places[: places.index(folder) + 1]:
        if found := folder_named(place, [IMAGES]):
            return place / found
    return None


def _models(folder):
    """The folders of models in the usual places; the folder itself where it has images, too."""
    places = [folder / place for place in PLACES if place != "." or holds_images(folder)]
    several = [near for place in PLACES[:-1] for near in sorted((folder / place).glob("[0-9]*"))]
    return [place for place in (*several, *places) if _suffix(place)]


def _count(model):
    """How many images a model has, by its header or its lines."""
    file = model / f"images{_suffix(model)}"
    with file.open("rb") as opened:
        if file.suffix == ".bin":
            return int.from_bytes(opened.read(8), "little")
        return sum(not line.startswith(b"#") for line in opened) // 2


def _suffix(folder):
    """Of a model's files in a folder, where binary ones go before text; None without a model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


def _photograph(folder, near, model, lenses, image):
    fail = fail_at(model, image.name)
    name, lens = find_image(folder, f"{near}/{image.name}", fail), lenses[image.camera]
    if isinstance(lens, Unusable):
        raise lens
    numbers = lens.parameters
    fx, fy, cx, cy, *coefficients = numbers if lens.model in TWO_FOCALS else (numbers[0], *numbers)
    is_fisheye = lens.model.endswith("FISHEYE")
    order = ("k1", "k2", "k3", "k4") if is_fisheye else PERSPECTIVE
    distortion = Distortion(**dict(zip(order, coefficients, strict=False)), fisheye=is_fisheye)
    w, x, y, z, *place = image.pose
    if not _are_numbers(image.pose) or abs(np.linalg.norm((w, x, y, z)) - 1) > 1e-3:
        raise Unusable(fail("its pose is no unit quaternion and place; fix it"), "no pose")
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.column_stack([rotation, -rotation @ place])
    camera = Camera(pose, fx, fy, cx, cy, lens.width, lens.height)
    camera = fitted(camera, image_size(folder / name, (lens.width, lens.height)), fail)
    return Photograph(name, camera, distortion=distortion)


# The model ----------------------------------------------------------------------------------------


def read_model(folder: Path) -> tuple[dict[int, Lens | Unusable], list[Image]]:
    """(cameras by id, or what is wrong with them, images) of the model in a folder; binary files go
    before text. Raises UserError naming the file, and the line or the place in it.
    """
    suffix = _suffix(folder)
    is_binary = suffix == ".bin"
    lenses, images, names = {}, [], set()
    file = folder / f"cameras{suffix}"
    for where, (identity, lens) in _bounded(file, _binary_cameras if is_binary else _text_cameras):
        model, width, height, parameters = lens
        if model not in MODELS:
            raise UserError(f"{where}: {model[:40]!r} {UNKNOWN}")
        if not 1 <= min(width, height) <= max(width, height) < MOST_PIXELS:
            raise UserError(f"{where}: {width}x{height} pixels is no size; copy the file again")
        if identity in lenses:
            raise UserError(f"{file}: camera {identity} stands there twice; remove one")
        if len(parameters) != MODELS[model] or not _are_numbers(parameters):
            text = f"{MODELS[model]} parameters, finite and not huge; copy the file again"
            lens = Unusable(f"{where}: {model} has {text}", BROKEN_CAMERA)
        lenses[identity] = lens
    file = folder / f"images{suffix}"
    for where, image in _bounded(file, _binary_images if is_binary else _text_images):
        # the name goes into messages of one line
        has_controls = any(unicodedata.category(letter) == "Cc" for letter in image.name)
        if has_controls or not 1 <= len(image.name) <= MOST_NAME:
            raise UserError(f"{where}: {image.name[:80]!r} is no name of an image; rename it")
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


def read_points(folder: Path) -> Iterator[tuple[float, ...]]:
    """Each (x, y, z, red, green, blue) of the points3D in a model's folder, which may have none.
    Raises UserError naming the file, and the line or the place in it.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    if binary.is_file():
        return _binary_points(binary)
    return _text_points(text) if text.is_file() else iter(())


def _bounded(file, read):
    """The entries of a file. Raises UserError where they are more than MOST_ENTRIES."""
    for count, entry in enumerate(read(file)):
        if count == MOST_ENTRIES:
            raise UserError(f"{file}: holds more than {MOST_ENTRIES} entries; split the model")
        yield entry


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


def _rows(file, lines, form, parse):
    """(place in words, what parse(line) gives) of each of the lines that is no comment. Raises
    UserError for one that is not of the form.
    """
    for number, line in lines:
        if line and not line.startswith("#"):
            where = f"{file}: line {number}"
            try:
                row = parse(line)
            except (IndexError, ValueError, OverflowError):
                raise UserError(f"{where}: is not {form}; copy the file again") from None
            yield where, row


def _text_cameras(file):
    """Each (place in words, (id, Lens))."""

    def parse(line):
        identity, model, width, height, *parameters = line.split()
        return int(identity), Lens(model, int(width), int(height), [float(p) for p in parameters])

    return _rows(file, _lines(file), "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", parse)


def _text_images(file):
    """Each (place in words, Image); it has two lines, of which the second, its 2D points, may be
    empty.
    """

    def parse(line):
        words = line.split(maxsplit=9)
        return Image(words[9], int(words[8]), [float(word) for word in words[1:8]])

    lines, form = _lines(file), "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    for where, image in _rows(file, lines, form, parse):
        number, line = next(lines, (0, ""))
        points = line.split()
        # else an image without its line of points would hide the next one
        if len(points) % 3 or (points and not points[-1].lstrip("-").isdecimal()):
            raise UserError(
                f"{file}: line {number}: must be the 2D points of {image.name[:80]!r}, X Y"
                " POINT3D_ID each; give every image a second line, empty if it has none"
            )
        yield where, image


def _text_points(file):
    def parse(line):
        _, x, y, z, red, green, blue, *_ = map(float, line.split(maxsplit=8)[:8])
        return x, y, z, red, green, blue

    for _, point in _rows(file, _lines(file), "POINT3D_ID X Y Z R G B", parse):
        yield point


# Binary -------------------------------------------------------------------------------------------


def _entries(file, take):
    """take(opened) of a binary file, as often as its first number says; the file must end there."""
    try:
        with opened_regular(file) as opened:
            (count,) = _take(opened, "Q")
            for _ in range(count):  # a count that is too large ends at the file's end
                yield take(opened)
            size = os.fstat(opened.fileno()).st_size
            if opened.tell() != size:
                raise ValueError(f"its entries end at byte {opened.tell()}, the file at {size}")
    except (OSError, OverflowError, ValueError) as error:
        raise refusal(file, error, "COLMAP's") from None


def _take(opened, form):
    """The next values of a struct format, little-endian. Raises ValueError at the file's end."""
    data = opened.read(struct.calcsize(f"<{form}"))
    if len(data) < struct.calcsize(f"<{form}"):
        raise ValueError(f"ends at byte {opened.tell()}, too early")
    return struct.unpack(f"<{form}", data)


def _binary_cameras(file):
    """Each (place in words, (id, Lens))."""
    names = list(MODELS)

    def take(opened):
        identity, number, width, height = _take(opened, "IiQQ")
        if not 0 <= number < len(names):
            raise ValueError(f"camera {identity}: {number} {UNKNOWN}")
        parameters = _take(opened, "d" * MODELS[names[number]])
        lens = Lens(names[number], width, height, parameters)
        return f"{file}: camera {identity}", (identity, lens)

    return _entries(file, take)


def _binary_images(file):
    """Each (place in words, Image)."""

    def take(opened):
        identity, *pose, camera = _take(opened, "IdddddddI")
        at = opened.tell()
        name, end, _ = opened.read(MOST_NAME).partition(b"\0")
        if not end:
            raise ValueError(f"the name at byte {at} does not end")
        opened.seek(at + len(name) + 1)
        (points,) = _take(opened, "Q")
        opened.seek(points * POINT2D_BYTES, os.SEEK_CUR)
        return f"{file}: image {identity}", Image(name.decode(), camera, pose)

    return _entries(file, take)


def _binary_points(file):
    def take(opened):
        _, *point, _, track = _take(opened, "QdddBBBdQ")
        opened.seek(track * TRACK_BYTES, os.SEEK_CUR)
        return point

    return _entries(file, take)
