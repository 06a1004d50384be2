"""Reader of scenes in the format of IDR and NeuS, such as DTU: cameras_sphere.npz or cameras.npz
with world_mat_i = K [R | t], and images in image/ (or images/) in the order of their names.
"""

import re
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from pp_cl.engine.camera import Camera
from pp_cl.files.image import image_size
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import LeftOut, folder_images, image_folder
from pp_cl.scene.readers.common import fail_at, in_order, read_npz

FILES = "cameras_sphere.npz (NeuS, DTU)"
STATES = "world-to-camera", "opencv"
CAMERAS = ("cameras_sphere.npz", "cameras.npz")
IMAGES = ("image", "images", "rgb")
MOST_SKEW = 1e-3  # pixels of shear over the image; our cameras have none


def recognises(folder: Path) -> bool:
    """Whether the folder has one of the files of cameras."""
    return _file(folder) is not None


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[ImageFile]:
    """The images of a split: every eighth in the order of names is for test. scale_mat, if present,
    gives the depth range. Raises UserError naming the file and the member.
    """
    file = _file(folder)
    matrices, scales = read_npz(file, "world_mat_"), read_npz(file, "scale_mat_")
    count = sum(re.fullmatch(r"world_mat_\d+", key) is not None for key in matrices)
    cameras = [f"world_mat_{index}" for index in range(count)]

    for key in cameras:
        if key not in matrices:
            raise fail_at(file, key)("is missing; number the cameras from 0")

    def read(index, name):
        key, scale = cameras[index], f"scale_mat_{index}"
        camera = _camera(matrices[key], image_size(folder / name), fail_at(file, key))
        if scale not in scales:
            return ImageFile(name, camera)
        middle, radius = _sphere(scales[scale], fail_at(file, scale))
        distance = np.linalg.norm(camera.eye - middle)
        near_far = max(distance - radius, 1e-3 * radius), distance + radius
        return ImageFile(name, camera, (float(near_far[0]), float(near_far[1])))

    images = folder_images(folder, image_folder(folder, IMAGES))
    return in_order(file, cameras, images, split, left_out, read)


def box(folder: Path) -> np.ndarray | None:
    """(2, 3) box around the sphere that the first scale_mat puts around the object, or None without
    one. Raises UserError as read_split() does.
    """
    file = _file(folder)
    scales = read_npz(file, "scale_mat_")
    if not scales:
        return None
    key = min(scales)
    middle, radius = _sphere(scales[key], fail_at(file, key))
    return np.stack([middle - radius, middle + radius])


def _file(folder):
    return next((folder / name for name in CAMERAS if (folder / name).is_file()), None)


def _camera(matrix, size, fail):
    """The Camera of a projection K [R | t]. Raises fail(text)."""
    if matrix.shape not in ((4, 4), (3, 4)):
        raise fail(f"has shape {matrix.shape}; must be 4x4 numbers")
    linear = matrix[:3, :3]
    determinant = np.linalg.det(linear)
    if not abs(determinant) > 1e-12 * max(np.abs(linear).max(), 1e-30) ** 3:
        raise fail("is singular; must be K [R | t]")
    # -K [R | t] projects as K [R | t] does, but nothing tells it from a world that is mirrored
    if determinant < 0:
        raise fail("is mirrored or negated; must be K [R | t] with a rotation R")
    upper, rotation = rq(linear)
    signs = np.sign(np.diag(upper))
    upper, rotation = upper * signs, signs[:, None] * rotation
    upper /= upper[2, 2]
    if abs(upper[0, 1]) * size[1] > MOST_SKEW * upper[1, 1]:
        raise fail(f"has a skew of {upper[0, 1]:.3g} pixels; cameras with skew are not modelled")
    pose = np.column_stack([rotation.T, -np.linalg.solve(linear, matrix[:3, 3])])
    return Camera(pose, upper[0, 0], upper[1, 1], upper[0, 2], upper[1, 2], *size)


def _sphere(matrix, fail):
    """((3,) middle, radius) of the sphere into which a matrix turns the unit sphere."""
    if matrix.shape != (4, 4):
        raise fail(f"has shape {matrix.shape}; must be 4x4 numbers")
    linear = matrix[:3, :3]
    radius = abs(np.linalg.det(linear)) ** (1 / 3)
    if radius == 0 or not np.allclose(linear @ linear.T / radius**2, np.eye(3), atol=1e-3):
        raise fail("must be a scaling and a translation; leave it out")
    return matrix[:3, 3], radius
