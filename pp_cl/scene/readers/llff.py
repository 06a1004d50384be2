"""Reader of scenes in the format of LLFF: poses_bounds.npy next to images/."""

from pathlib import Path

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import image_size
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import LeftOut, folder_images, image_folder
from pp_cl.scene.readers.common import fail_at, fitted, in_order, read_npy
from pp_cl.scene.readers.frame import rigid

FILES = "poses_bounds.npy (LLFF)"
STATES = "camera-to-world", "opengl"
POSES = "poses_bounds.npy"
NUMBERS = 17  # a 3x4 pose with (height, width, focal length) as its fifth column; near, far
# LLFF: down, right, backwards; OpenCV: right, down, forwards
LLFF_FROM_CV = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def recognises(folder: Path) -> bool:
    """Whether the folder has the file of poses."""
    return (folder / POSES).is_file()


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[ImageFile]:
    """The images of a split, in the order of their names. Near and far are not used, as they bound
    the whole photographed space. Raises UserError naming the file and the row.
    """
    file = folder / POSES
    rows = read_npy(file)
    if rows.ndim != 2 or rows.shape[1] != NUMBERS:
        raise UserError(f"{file}: has shape {rows.shape}; must be {NUMBERS} numbers for each image")

    def read(index, name):
        fail, matrix = fail_at(file, f"row {index}"), rows[index, :15].reshape(3, 5)
        height, width, focal = matrix[:, 4]
        if not min(height, width, focal) > 0:
            raise fail(
                f"height {height:g}, width {width:g}, focal length {focal:g}: must be above 0"
            )
        pose = rigid(np.column_stack([matrix[:, :3] @ LLFF_FROM_CV, matrix[:, 3]]), fail)
        camera = Camera(pose, focal, focal, width / 2, height / 2, width, height)
        return ImageFile(name, fitted(camera, image_size(folder / name, (width, height)), fail))

    cameras = [f"row {index}" for index in range(len(rows))]
    images = folder_images(folder, image_folder(folder))
    return in_order(file, cameras, images, split, left_out, read)
