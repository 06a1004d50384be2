"""Reader of scenes as NSVF has them: rgb/ with the split in front of the names, pose/, one
intrinsics.txt, and near_and_far.txt where it is there. bbox.txt, the box of NSVF's voxels, is not
read.
"""

from pathlib import Path

import numpy as np

from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import image_size
from pp_cl.scene.camera import Camera
from pp_cl.scene.readers.common import fail_at, fitted, folder_images, read_numbers
from pp_cl.scene.readers.found import Notes
from pp_cl.scene.readers.frame import rigid
from pp_cl.scene.views import Photograph

FILES = "rgb, pose and intrinsics.txt (NSVF)"
PREFIXES = {"0_": "train", "1_": "val", "2_": "test"}
IMAGES, POSES, INTRINSICS = "rgb", "pose", "intrinsics.txt"


def recognises(folder: Path) -> bool:
    """True if the folder has the two folders and the intrinsics."""
    return all((folder / name).is_dir() for name in (IMAGES, POSES)) and (
        (folder / INTRINSICS).is_file()
    )


def splits(folder: Path) -> list[str]:
    """The splits that names of images begin with: 0_ train, 1_ val, 2_ test; without 2_, as in
    NSVF's Tanks and Temples and BlendedMVS, 1_ is test.
    """
    return sorted(_names(folder))


def read_split(folder: Path, split: str, notes: Notes) -> list[Photograph]:
    """The photographs of a split, in the order of their names. Poses are camera-to-world with
    OpenCV's axes; near and far are Euclidean distances. Raises UserError naming the file.
    """
    names = _names(folder)
    file = folder / INTRINSICS
    (fx, fy, cx, cy), stated = _lens(file)
    depth_range = _depth_range(folder / "near_and_far.txt")

    def read(name):
        pose = _pose(folder / POSES / f"{Path(name).stem}.txt")
        size = image_size(folder / name, stated)
        camera = Camera(pose, fx, fy, cx, cy, *(stated or size))
        return Photograph(name, fitted(camera, size, fail_at(file)), depth_range)

    return list(notes.usable(names[split], read, str))


def _names(folder):
    """{split: names of its images}. Raises UserError where no name has a prefix."""
    names = {}
    for name in folder_images(folder, IMAGES):
        split = PREFIXES.get(Path(name).name[:2])
        if split:
            names.setdefault(split, []).append(name)
    if not names:
        raise UserError(
            f"{folder / IMAGES}: no image belongs to a split; begin their names with 0_ (train),"
            " 1_ (val) or 2_ (test)"
        )
    if "test" not in names and "val" in names:
        names["test"] = names.pop("val")
    return names


def _pose(file):
    """(3, 4) of a file of 4x4 numbers."""
    if not file.exists():
        raise Unusable(f"{file}: no such file; copy it there", "no pose")
    rows = read_numbers(file)
    if [len(row) for row in rows] != [4] * 4:
        raise Unusable(f"{file}: must be 4x4 numbers, a camera-to-world matrix", "no pose")
    return rigid(rows, fail_at(file))


def _lens(file):
    """((fx, fy, cx, cy), the (width, height) they are meant for or None): a 4x4 or 3x3 matrix, or
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
    return lens, size


def _depth_range(file):
    """(near, far), None without the file."""
    if not file.is_file():
        return None
    values = [value for row in read_numbers(file) for value in row]
    if len(values) != 2 or not 0 < values[0] < values[1]:
        raise UserError(f"{file}: must be two numbers, 0 < near < far")
    return values[0], values[1]
