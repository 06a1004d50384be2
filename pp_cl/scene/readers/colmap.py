"""Reader of COLMAP's sparse models: cameras and images, text or binary, next to a folder of images
and, for objects, a folder of masks.

Formats: https://colmap.github.io/format.html. Files are read piece by piece and points are skipped,
since they make up nearly the whole file.
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
from pp_cl.errors import BROKEN_CAMERA, Unusable, UserError, pasted
from pp_cl.files.image import image_size
from pp_cl.files.untrusted import UTF_16, opened_regular, refusal
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lens import LensDistortion
from pp_cl.scene.lookup import (
    LeftOut,
    find_image,
    folder_named,
    folder_of,
    holds_images,
    listed_in,
    nested,
    usable,
)
from pp_cl.scene.readers.common import (
    CUT_UP,
    MOST,
    PANORAMIC,
    as_number,
    fail_at,
    fitted,
    hold_out,
    progress,
)

FILES = "a sparse model of COLMAP next to images"
STATES = "world-to-camera", "opencv"
# usual places of models, which may also lie in numbered subfolders of these; RealityScan puts its
# model into the folder itself. If none has a model, deeper folders are searched.
PLACES = ("sparse", "colmap/sparse", "dense/sparse", "dense/0/sparse", ".")
IMAGES = "images"
LISTS = {"test": "test.txt", "train": "train.txt"}  # of image names, beside a model

# number of parameters of each camera model of COLMAP, in the order of their ids
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
    PANORAMIC: 2,
}
NOT_READ = (
    *("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "EUCM", PANORAMIC),
)
ONE_FOCAL = ("SIMPLE_", "RADIAL")  # the names of models with one focal length begin so
MOST_PIXELS = 2**20  # a longer side is not believed
MOST_RECORDS = 2**17  # cameras or images in a file
MOST_NAME = 1024  # bytes of an image's name
MOST_LINE = 2**22  # characters of a line: 150,000 2D points
PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in COLMAP's order
UNKNOWN = "is no known camera model; undistort with `colmap image_undistorter`, or copy it again"
POINT2D_BYTES = 24  # x, y and the id of a 3D point
TRACK_BYTES = 8  # the ids of an image and of a point in it


class Lens(NamedTuple):
    """A camera of the model, with its parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: Sequence[float]


class Image(NamedTuple):
    """An image of the model. pose: (7,) qw, qx, qy, qz, tx, ty, tz, world to camera."""

    name: str
    camera: int
    pose: Sequence[float]


def recognises(folder: Path) -> bool:
    """Whether the folder has a model in one of the usual places."""
    return bool(_usual_models(folder))


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[ImageFile]:
    """The images of a split: those of LISTS beside the model, as 3DGS has them; without lists,
    every eighth in the order of names is for test. Cameras are scaled to images that were reduced
    afterwards. Raises UserError naming the file and the image.
    """
    model = model_folder(folder) or folder
    if (count := len(_models(folder))) > 1:
        text = f"of {count} models, the largest with images next to it is read ({model})"
        warnings.warn(f"{folder}: {text}", stacklevel=1)
    lenses, images = read_model(model)
    undistort = (
        "is not read; convert with `colmap image_undistorter --image_path"
        f" {pasted(folder / IMAGES)} --input_path {pasted(model)} --output_path NEW` and give NEW"
    )
    for identity, lens in lenses.items():
        if isinstance(lens, Lens) and lens.model in NOT_READ:
            why = CUT_UP if lens.model == PANORAMIC else undistort
            text = f"{model}: camera model {lens.model} {why}"
            lenses[identity] = Unusable(text, "a lens that is not modelled")
    images.sort(key=lambda image: image.name)
    near = _images_of(folder, model) or folder_of(folder, [image.name for image in images])
    near = near or folder / IMAGES
    chosen = _listed(model, images, split)
    if chosen is None:
        chosen = hold_out(images, split, [near / image.name for image in images])
    read = partial(_image_file, folder, near.relative_to(folder).as_posix(), model, lenses)
    return list(usable(progress(chosen), read, lambda image: image.name, left_out))


def _listed(model, images, split):
    """The images of a split by LISTS; None without them. What only one list leaves is the other's,
    and no image is in both: training gets none that are for test.
    """
    names = [image.name for image in images]
    of_split = {
        name: listed_in(model / file, names)
        for name, file in LISTS.items()
        if (model / file).is_file()
    }
    if not of_split:
        return None
    test = of_split["test"] if "test" in of_split else {*names} - of_split["train"]
    chosen = test if split == "test" else of_split.get("train", {*names}) - test
    told = " and ".join(LISTS[name] for name in of_split)
    warnings.warn(f"{model}: splits are as {told} lists them", stacklevel=1)
    return [image for image in images if image.name in chosen]


def model_folder(folder: Path) -> Path | None:
    """The folder of a scene's model, or None. Of several models, those with images next to them go
    first, then the largest.
    """
    models = _models(folder)
    if len(models) < 2:
        return next(iter(models), None)
    return max(models, key=lambda model: (_images_of(folder, model) is not None, _count(model)))


def _images_of(folder, model):
    """The folder of images nearest above a model, within the scene's folder, or None."""
    places = [model, *model.parents]
    for place in places[: places.index(folder) + 1]:
        if images := folder_named(place, [IMAGES]):
            return place / images
    return None


def _models(folder):
    """The folders of models in the usual places, or else deeper."""
    return _usual_models(folder) or nested(folder, _suffix)


def _usual_models(folder):
    """The folders of models in PLACES; the folder itself counts only if it has images, too."""
    places = [folder / place for place in PLACES if place != "." or holds_images(folder)]
    several = [near for place in PLACES[:-1] for near in sorted((folder / place).glob("[0-9]*"))]
    return [place for place in (*several, *places) if _suffix(place)]


def _count(model):
    """The number of images in a model, from its header or its lines."""
    file = model / f"images{_suffix(model)}"
    with file.open("rb") as opened:
        if file.suffix == ".bin":
            return int.from_bytes(opened.read(8), "little")
        return sum(not line.startswith(b"#") for line in opened) // 2


def _suffix(folder):
    """The suffix of a model's files in a folder, .bin before .txt; None without a model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


def _image_file(folder, near, model, lenses, image):
    fail = fail_at(model, image.name)
    name, lens = find_image(folder, f"{near}/{image.name}", fail), lenses.get(image.camera)
    if lens is None:
        text = f"its camera {image.camera} is not in cameras; copy both files from one model"
        raise Unusable(fail(text), BROKEN_CAMERA)
    if isinstance(lens, Unusable):
        raise lens
    numbers = list(lens.parameters)
    if lens.model.startswith(ONE_FOCAL):
        numbers.insert(0, numbers[0])
    fx, fy, cx, cy, *coefficients = numbers
    is_fisheye = lens.model.endswith("FISHEYE")
    order = ("k1", "k2", "k3", "k4") if is_fisheye else PERSPECTIVE
    distortion = LensDistortion(**dict(zip(order, coefficients, strict=False)), fisheye=is_fisheye)
    w, x, y, z, *place = image.pose
    if not _are_numbers(image.pose) or abs(np.linalg.norm((w, x, y, z)) - 1) > 1e-3:
        raise Unusable(fail("its pose must be a unit quaternion and a place; fix it"), "no pose")
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.column_stack([rotation, -rotation @ place])
    camera = Camera(pose, fx, fy, cx, cy, lens.width, lens.height)
    camera = fitted(camera, image_size(folder / name, (lens.width, lens.height)), fail)
    return ImageFile(name, camera, lens=distortion)


# The model ----------------------------------------------------------------------------------------


def _check_number(file, records):
    if len(records) > MOST_RECORDS:
        raise UserError(f"{file}: holds more than {MOST_RECORDS} records; split the model")


def read_model(folder: Path) -> tuple[dict[int, Lens | Unusable], list[Image]]:
    """({id: camera, or the error about it}, images) of a folder's model. Raises UserError naming
    the file and the line or place in it.
    """
    suffix = _suffix(folder)
    lenses: dict[int, Lens | Unusable] = {}
    file = folder / f"cameras{suffix}"
    for where, (identity, lens) in _records(file, _binary_camera, CAMERA, _text_camera):
        model, width, height, parameters = lens
        if model not in MODELS:
            raise UserError(f"{where}: {model[:40]!r} {UNKNOWN}")
        if identity in lenses:
            raise UserError(f"{file}: camera {identity} is listed twice; remove one")
        if not 1 <= min(width, height) <= max(width, height) < MOST_PIXELS:
            text = f"{where}: {width}x{height} pixels is no valid size; copy the file again"
            lens = Unusable(text, BROKEN_CAMERA)
        elif len(parameters) != MODELS[model] or not _are_numbers(parameters):
            text = f"{MODELS[model]} parameters, finite and not huge; copy the file again"
            lens = Unusable(f"{where}: {model} must have {text}", BROKEN_CAMERA)
        lenses[identity] = lens
        _check_number(file, lenses)
    images: dict[PurePosixPath, Image] = {}
    file = folder / f"images{suffix}"
    for where, image in _records(file, _binary_image, IMAGE, _text_image):
        # the name goes into messages of one line
        has_controls = any(unicodedata.category(letter) == "Cc" for letter in image.name)
        if has_controls or not 1 <= len(image.name) <= MOST_NAME:
            raise UserError(f"{where}: {image.name[:80]!r} is no valid image name; rename it")
        name = PurePosixPath(image.name)  # ./a.png is a.png
        if images.get(name, image)[1:] != image[1:]:
            raise UserError(f"{file}: {image.name}: is listed twice; remove one")
        images[name] = image
        _check_number(file, images)
    if not images:
        raise UserError(f"{file}: holds no images; run COLMAP's mapper again")
    return lenses, list(images.values())


def read_points(folder: Path) -> Iterator[Sequence[float]]:
    """Yield (x, y, z, red, green, blue) of each of a model's points3D. Raises UserError."""
    files = (folder / f"points3D{suffix}" for suffix in (".bin", ".txt"))
    for file in [file for file in files if file.is_file()][:1]:
        yield from (point for _, point in _records(file, _binary_point, POINT, _text_point))


def _are_numbers(values):
    """Whether all are finite and not huge."""
    return all(abs(value) < MOST for value in values)


def _records(file, take, form, parse):
    """Yield (its place in words, the record) for each record of a file. take(opened) reads a record
    from a binary file; parse(line) reads it from a line of a text file, whose fields are `form`.
    """
    is_binary = file.suffix == ".bin"
    try:
        yield from _binary_entries(file, take) if is_binary else _text_entries(file, form, parse)
    except (OSError, OverflowError, ValueError) as error:
        raise refusal(file, error, "COLMAP's" if is_binary else "text") from None


# Text ---------------------------------------------------------------------------------------------

CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
POINT = "POINT3D_ID X Y Z R G B"


def _text_entries(file, form, parse):
    with opened_regular(file) as binary:
        encoding = "utf-16" if binary.read(2) in UTF_16 else "utf-8-sig"
    with file.open(encoding=encoding, errors="surrogateescape") as opened:
        lines = enumerate(iter(lambda: opened.readline(MOST_LINE), ""), 1)
        for number, line in lines:
            if len(line) == MOST_LINE:
                raise ValueError(f"line {number} has {MOST_LINE} characters or more")
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            where = f"{file}: line {number}"
            try:
                record = parse(line.strip())
            except (IndexError, ValueError, OverflowError):
                raise UserError(f"{where}: is not {form}; copy the file again") from None
            if form == IMAGE:  # the next line has its 2D points
                number, line = next(lines, (0, ""))
                points = line.split()
                # an image without its line of points would otherwise hide the next image
                if len(points) % 3 or (points and not points[-1].lstrip("-").isdecimal()):
                    raise UserError(
                        f"{file}: line {number}: must be the 2D points of {record.name[:80]!r}, X Y"
                        " POINT3D_ID each; give every image a second line, empty if it has none"
                    )
            yield where, record


def _text_camera(line):
    identity, model, width, height, *parameters = line.split()
    size = int(as_number(width)), int(as_number(height))
    return int(identity), Lens(model, *size, [as_number(p) for p in parameters])


def _text_image(line):
    words = line.split(maxsplit=9)
    return Image(words[9], int(words[8]), [as_number(word) for word in words[1:8]])


def _text_point(line):
    _, x, y, z, red, green, blue = map(as_number, line.split(maxsplit=7)[:7])
    return x, y, z, red, green, blue


# Binary -------------------------------------------------------------------------------------------


def _binary_entries(file, take):
    """Yield take(opened) as often as the file's first number says; the file must end there."""
    with opened_regular(file) as opened:
        (count,) = _take(opened, "Q")
        for index in range(count):  # too large a count ends at the file's end
            yield f"{file}: record {index + 1}", take(opened)
        size = os.fstat(opened.fileno()).st_size
        if opened.tell() != size:
            raise ValueError(f"its records end at byte {opened.tell()}, the file at {size}")


def _take(opened, form):
    """The next values of a struct format, little-endian. Raises ValueError at the file's end."""
    data = opened.read(struct.calcsize(f"<{form}"))
    if len(data) < struct.calcsize(f"<{form}"):
        raise ValueError(f"ends at byte {opened.tell()}, too early")
    return struct.unpack(f"<{form}", data)


def _binary_camera(opened):
    identity, number, width, height = _take(opened, "IiQQ")
    if not 0 <= number < len(MODELS):
        raise ValueError(f"camera {identity}: {number} {UNKNOWN}")
    model = list(MODELS)[number]
    return identity, Lens(model, width, height, _take(opened, "d" * MODELS[model]))


def _binary_image(opened):
    _, *pose, camera = _take(opened, "IdddddddI")
    at = opened.tell()
    name, end, _ = opened.read(MOST_NAME).partition(b"\0")
    if not end:
        raise ValueError(f"the name at byte {at} does not end")
    opened.seek(at + len(name) + 1)
    (points,) = _take(opened, "Q")
    opened.seek(points * POINT2D_BYTES, os.SEEK_CUR)
    return Image(name.decode(errors="surrogateescape"), camera, pose)


def _binary_point(opened):
    _, *point, _, track = _take(opened, "QdddBBBdQ")
    opened.seek(track * TRACK_BYTES, os.SEEK_CUR)
    return point
