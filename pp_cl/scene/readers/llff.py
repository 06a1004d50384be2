"""Reader of scenes as LLFF has them: poses_bounds.npy beside images/."""

from pathlib import Path

import numpy as np

from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import image_size
from pp_cl.scene.camera import Camera
from pp_cl.scene.readers.common import (
    SPLITS,
    fail_at,
    fitted,
    folder_images,
    hold_out,
    read_npy,
)
from pp_cl.scene.readers.found import Notes, image_folder, numbered
from pp_cl.scene.readers.frame import rigid
from pp_cl.scene.views import Photograph

FILES = "poses_bounds.npy (LLFF)"
POSES = "poses_bounds.npy"
NUMBERS = 17  # 3x4 pose, (height, width, focal length) as its fifth column; near, far
# LLFF: down, right, backwards; OpenCV: right, down, forwards
LLFF_FROM_CV = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def recognises(folder: Path) -> bool:
    """True if the folder has the file of poses."""
    return (folder / POSES).is_file()


def splits(folder: Path) -> list[str]:
    """Train and test: test is every eighth image, as LLFF has it."""
    return SPLITS


def read_split(folder: Path, split: str, notes: Notes) -> list[Photograph]:
    """The photographs of a split, in the order of their names.

    Where the images are smaller or larger than the poses say, the focal length is scaled. Near and
    far bound all that was photographed, not the object, and are left out. Where images are gone,
    the numbers in the names of the others tell their poses. Raises UserError naming the file and
    the image.
    """
    file, images = folder / POSES, image_folder(folder)
    names, rows = folder_images(folder, images), read_npy(file)
    count = rows.shape[0] if rows.ndim == 2 and rows.shape[1] == NUMBERS else 0
    if (places := numbered(names, count)) is None:
        raise UserError(
            f"{file}: has shape {rows.shape}, but {images}/ has {len(names)} images; must be"
            f" {len(names)}x{NUMBERS} numbers; remove the images without a pose, or find the"
            " poses again"
        )

    def read(index):
        if index not in places:
            raise Unusable(f"{file}: row {index}: its image is gone from {images}", "no image")
        name, matrix = places[index], rows[index, :15].reshape(3, 5)
        size = image_size(folder / name, (matrix[1, 4], matrix[0, 4]))
        return Photograph(name, _camera(matrix, size, fail_at(file, f"row {index}")))

    return list(notes.usable(hold_out(range(count), split), read, "row {}".format))


def _camera(matrix, size, fail):
    """The Camera, its principal point in the middle. Raises fail(text)."""
    height, width, focal = matrix[:, 4]
    if not (height > 0 and width > 0 and focal > 0):
        raise fail(f"height {height:g}, width {width:g}, focal length {focal:g} must be above 0")
    pose = rigid(np.column_stack([matrix[:, :3] @ LLFF_FROM_CV, matrix[:, 3]]), fail)
    camera = Camera(pose, focal, focal, width / 2, height / 2, width, height)
    return fitted(camera, size, fail)
