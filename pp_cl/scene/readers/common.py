"""Functions that readers share: splits, images in order, numbers in JSON, numpy and text files."""

import json
import math
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.errors import Unusable, UserError, quoted, shown
from pp_cl.files.image import same_shape
from pp_cl.files.untrusted import (
    opened_regular,
    opened_zip,
    read_json_text,
    read_regular,
    refusal,
)
from pp_cl.progress import track
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import Fail, LeftOut, natural, numbered, pictures_of, usable

HELD_OUT = 8  # every eighth image, from the first on, is for test, as in LLFF and 3DGS
SPLITS = ["test", "train"]  # of a format without splits
MOST_JSON = 2**26  # bytes of a JSON file: 100,000 frames of 670
MOST_ARRAYS = 2**25  # bytes of all arrays in a file, as float64: 100,000 cameras need 25 million
MOST_TEXT = 2**20  # bytes of a file with the numbers of one camera
MOST = 1e30  # larger numbers are refused: float32 could not hold their products
PANORAMIC = "EQUIRECTANGULAR"  # COLMAP's and nerfstudio's name for a lens that sees all around
CUT_UP = "is panoramic; cut perspective images out of the panoramas and find their cameras"
KINDS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # used by numpy's savez and savez_compressed

Item = TypeVar("Item")


# Splits -------------------------------------------------------------------------------------------


def hold_out(items: Sequence[Item], split: str, files: Sequence[Path] = ()) -> list[Item]:
    """The items of a split: every eighth picture for test, the others for train. files: the items'
    image files, if copies are to count as one picture.
    """
    pictures = pictures_of(files) if files else range(len(items))
    place = {picture: index for index, picture in enumerate(dict.fromkeys(pictures))}
    is_test = split == "test"
    return [
        item
        for item, picture in zip(items, pictures, strict=True)
        if (place[picture] % HELD_OUT == 0) == is_test
    ]


def progress(items: Sequence[Item]) -> Iterable[Item]:
    """The items, with a progress bar, as there may be thousands."""
    return track(items, "checking images", "image")


# Images -------------------------------------------------------------------------------------------


def in_order(
    file: Path,
    cameras: Sequence[str],
    images: Sequence[str],
    split: str,
    left_out: LeftOut,
    read: Callable[[int, str], ImageFile],
) -> list[ImageFile]:
    """The images of a split, for a file whose cameras have no image names but the order of the
    images' names, or of their numbers if all names are numbers. If images are missing, numbers in
    the names tell which. cameras: their names in the file. read(index, image) gives an ImageFile.
    Raises UserError if the names do not tell which images are missing.
    """
    if all(PurePosixPath(image).stem.isdecimal() for image in images):
        ordered = sorted(images, key=natural)
        if ordered != list(images):
            what = "cameras are taken in the order of the numbers that are the images' names"
            warnings.warn(f"{file}: {what}", stacklevel=1)
        images = ordered
    places = numbered(images, len(cameras))
    if places is None:
        raise UserError(
            f"{file}: has {len(cameras)} cameras, but there are {len(images)} images, such as"
            f" {images[0]}; remove images without a camera, or copy both again"
        )

    def read_one(index):
        if index not in places:
            raise Unusable(f"{file}: {cameras[index]}: its image is missing", "no image")
        return read(index, places[index])

    files = [file.parent / places.get(index, "") for index in range(len(cameras))]
    chosen = hold_out(range(len(cameras)), split, files)
    return list(usable(chosen, read_one, cameras.__getitem__, left_out))


def fail_at(*place: object) -> Fail:
    """A function fail(text) for errors at a place: the file, and parts of it."""
    return lambda text: UserError(f"{': '.join(map(str, place))}: {text}")


def fitted(camera: Camera, size: tuple[int, int], fail: Fail) -> Camera:
    """The camera scaled to an image of (width, height) `size`. Raises Unusable with fail()'s text
    if the aspect ratios differ by more than rounding.
    """
    width, height = camera.width, camera.height
    if not same_shape(size, (width, height)):
        is_turned = same_shape(size[::-1], (width, height))
        what = "turned; write the images upright" if is_turned else "another shape; copy it again"
        text = f"is for {width:g}x{height:g} pixels, but an image has {size[0]}x{size[1]}, {what}"
        raise Unusable(fail(text), "an image of another shape than its camera's")
    x, y = size[0] / width, size[1] / height
    fx, fy, cx, cy = x * camera.fx, y * camera.fy, x * camera.cx, y * camera.cy
    return Camera(camera.pose, fx, fy, cx, cy, *size)


def checked_box(corners: object, fail: Fail) -> np.ndarray:
    """(2, 3) lower and upper corner of a box that a file states. Raises fail(text)."""
    box = numbers(corners, (2, 3))
    if box is None or not (box[1] > box[0]).all():
        raise fail(
            f"is {quoted(corners, 60)}; must be two corners of three numbers, the upper one larger"
            " in x, y and z"
        )
    return box


# Files of numbers ---------------------------------------------------------------------------------


def numbers(value: Any, shape: tuple[int, ...] | None = None) -> np.ndarray | None:
    """float64 array from nested lists of numbers or from an array; None from anything else. shape:
    if given, the only shape allowed, and numbers must be finite and not huge.
    """
    try:
        leaves = np.array(value, object).ravel()
        if any(isinstance(leaf, (str, bytes, bool)) for leaf in leaves):
            return None
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    fits = shape is None or (array.shape == shape and (np.abs(array) < MOST).all())
    return array if fits else None


def read_json(file: Path) -> Any:
    """Content of a JSON file; image names need not be UTF-8. Raises UserError naming the file and
    the broken place.
    """
    try:
        return json.loads(read_json_text(file, MOST_JSON, "utf-8-sig", "surrogateescape"))
    except json.JSONDecodeError as error:
        raise UserError(
            f"{file}: line {error.lineno}, column {error.colno}: {error.msg}; correct the JSON"
            " there"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise refusal(file, error, "JSON") from error


def read_npy(file: Path) -> np.ndarray:
    """The array of a .npy file as float64. Raises UserError naming the file."""
    try:
        with opened_regular(file) as opened:
            return _read_array(opened, MOST_ARRAYS)
    except Exception as error:  # numpy raises all kinds of exceptions on broken bytes
        raise refusal(file, error, "numpy's arrays") from None


def read_npz(file: Path, wanted: str) -> dict[str, np.ndarray]:
    """{name: float64 array} of the members of a .npz file whose names begin with `wanted`. Raises
    UserError naming the file.
    """
    arrays, bytes_left = {}, MOST_ARRAYS
    try:
        with opened_zip(file) as archive:
            for zip_info in archive.infolist():
                name = zip_info.filename.removesuffix(".npy")
                if name == zip_info.filename or not name.startswith(wanted):
                    continue
                if zip_info.compress_type not in KINDS:  # others may need much memory
                    raise ValueError(f"{name} is compressed in a way that numpy does not use")
                with archive.open(zip_info) as opened:
                    arrays[name] = _read_array(opened, bytes_left)
                bytes_left -= arrays[name].nbytes
    except Exception as error:  # zipfile and numpy raise all kinds of exceptions on broken bytes
        raise refusal(file, error, "numpy's arrays") from None
    return arrays


def _read_array(opened, most):
    """The array of an opened .npy file as float64, if that takes at most `most` bytes."""
    if np.lib.format.read_magic(opened) != (1, 0):  # other versions have headers of up to 4 GiB
        raise ValueError("is of another version than 1.0")
    shape, _, dtype = np.lib.format.read_array_header_1_0(opened)
    if dtype.kind not in "fiu":
        raise ValueError(f"holds {dtype} in place of numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * max(dtype.itemsize, 8) > most:
        raise ValueError(f"claims the shape {shown(str(shape), 40)}, more than {most} bytes")
    opened.seek(0)
    array = np.lib.format.read_array(opened, allow_pickle=False).astype(np.float64)
    if not (np.abs(array) < MOST).all():
        raise ValueError("holds NaN, Inf or a huge number")
    return array


def as_number(word: str) -> float:
    """The number that a word of text means; it may have a decimal comma. NaN for what Windows
    writes for NaN and infinity, such as -nan(ind) and 1.#INF. Raises ValueError.
    """
    if re.fullmatch(r"[+-]?(nan\(\w*\)|1\.#\w+)", word, re.IGNORECASE):
        return math.nan
    return float(word.replace(",", ".") if word.count(",") == 1 and "." not in word else word)


def read_numbers(file: Path) -> list[list[float]]:
    """The numbers of each line of a text file. Raises UserError naming the file and the line."""
    try:
        lines = read_regular(file, MOST_TEXT, "utf-8-sig").split("\n")
    except (OSError, ValueError) as error:
        raise refusal(file, error, "text") from None
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = [as_number(word) for word in line.split()]
        except ValueError:
            row = [math.nan]
        if not all(abs(value) < MOST for value in row):
            raise UserError(
                f"{file}: line {number}: {line[:60]!r} must be finite numbers; write it again"
            )
        rows.append(row)
    return [row for row in rows if row]
