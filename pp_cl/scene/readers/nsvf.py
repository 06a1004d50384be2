"""Reader of scenes as NSVF has them: rgb/ with the split in front of the names, pose/, one
intrinsics.txt, and near_and_far.txt where it is there.
"""

from functools import partial
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.image import image_size
from pp_cl.scene.camera import Camera
from pp_cl.scene.photograph import Photograph
from pp_cl.scene.readers.arrays import read_numbers
from pp_cl.scene.readers.common import check_split, folder_images
from pp_cl.scene.readers.frame import rigid

FILES = "rgb, pose and intrinsics.txt (NSVF)"
PREFIXES = {"0_": "train", "1_": "val", "2_": "test"}
IMAGES, POSES, INTRINSICS = "rgb", "pose", "intrinsics.txt"


def recognises(folder: Path) -> bool:
    """True if the folder has the two folders and the intrinsics."""
    return all((folder / name).is_dir() for name in (IMAGES, POSES)) and (
        (folder / INTRINSICS).is_file()
    )


def splits(folder: Path) -> list[str]:
    """The splits that names of images begin with: 0_ train, 1_ val, 2_ test."""
    names = [Path(name).name for name in folder_images(folder, IMAGES)]
    return sorted({PREFIXES[name[:2]] for name in names if name[:2] in PREFIXES})


def read_split(folder: Path, split: str) -> list[Photograph]:
    """The photographs of a split, in the order of their names. Poses are camera-to-world with
    OpenCV's axes. Raises UserError naming the file.
    """
    check_split(folder, split, splits(folder))
    lens, depth_range = _lens(folder / INTRINSICS), _depth_range(folder / "near_and_far.txt")
    read = []
    for name in folder_images(folder, IMAGES):
        stem = Path(name).stem
        if PREFIXES.get(stem[:2]) != split:
            continue
        file, size = folder / POSES / f"{stem}.txt", image_size(folder / name)
        rows = read_numbers(file)
        if [len(row) for row in rows] != [4] * 4:
            raise UserError(f"{file}: must be 4x4 numbers, a camera-to-world matrix")
        pose = rigid(rows, partial(_error, file))
        read.append(Photograph(name, Camera(pose, *_scaled(lens, size), *size), depth_range))
    return read


def _error(file, text):
    return UserError(f"{file}: {text}")


def _lens(file):
    """(fx, fy, cx, cy, (width, height) they are meant for or None): a 4x4 or 3x3 matrix, or
    `focal cx cy 0` in the first line and the height and width in the last.
    """
    rows = read_numbers(file)
    lengths = {len(row) for row in rows}
    if (len(rows), lengths) in ((4, {4}), (3, {3})):
        k = np.array(rows)
        lens, size = (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), None
        if abs(k[0, 1]) > 1e-6 * abs(k[0, 0]):
            raise UserError(f"{file}: has a skew of {k[0, 1]:.3g} pixels, which is not modelled")
    elif rows and len(rows[0]) in (3, 4):
        focal, cx, cy = rows[0][:3]
        lens = focal, focal, cx, cy
        size = (rows[-1][1], rows[-1][0]) if len(rows) > 1 and len(rows[-1]) == 2 else None
    else:
        raise UserError(f"{file}: must be a 4x4 matrix, or begin with focal length, cx and cy")
    if not (lens[0] > 0 and lens[1] > 0):
        raise UserError(f"{file}: the focal length is {min(lens[:2]):g}; must be above 0")
    if size is not None and not min(size) > 0:
        raise UserError(f"{file}: the last line must be the height and the width of the images")
    return *lens, size


def _scaled(lens, size):
    """(fx, fy, cx, cy) for images of another size."""
    *values, stated = lens
    if stated is None or tuple(stated) == size:
        return values
    x, y = size[0] / stated[0], size[1] / stated[1]
    return values[0] * x, values[1] * y, values[2] * x, values[3] * y


def _depth_range(file):
    """(near, far), None without the file."""
    if not file.is_file():
        return None
    values = [value for row in read_numbers(file) for value in row]
    if len(values) != 2 or not 0 < values[0] < values[1]:
        raise UserError(f"{file}: must be two numbers, 0 < near < far")
    return values[0], values[1]
