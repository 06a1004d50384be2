"""Other ways to read the cameras of a scene than its format defines, for the mistakes that programs
and people make. A reading is one or more of the words below, as in `axes` of pp_cl.json.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl.engine.camera import Camera
from pp_cl.files.image import exif_turns
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import natural

STATED = "stated"  # the cameras are right as the format defines them
# {kind of matrix: (whether its rotation is camera-to-world, whether its last column is the centre)}
MATRICES = {
    "camera-to-world": (True, True),
    "world-to-camera": (False, False),
    "centres": (False, True),
    "translations": (True, False),
}
# {axes of a camera: signs of its x, y and z relative to the format's axes}
AXES = {
    "opencv": (1, -1, -1),
    "opengl": (1, -1, -1),
    "left-handed": (1, 1, -1),
    "mirrored": (-1, 1, 1),
    "upside-down": (-1, -1, 1),
}
QUATERNIONS = {"xyzw": 1, "wxyz": -1}  # shift that brings their numbers into the order x, y, z, w
SQUARE, EXIF = "square-pixels", "exif"
ORDERS = ("by-number", "by-name", "next", "previous")
MEANING = {
    "camera-to-world": "matrices from the camera to the world",
    "world-to-camera": "matrices from the world to the camera",
    "centres": "rotations from the world, with the cameras' centres in place of translations",
    "translations": "rotations to the world, with translations in place of the cameras' centres",
    "opencv": "axes of OpenCV (y down, z forward)",
    "opengl": "axes of OpenGL (y up, z backward)",
    "left-handed": "left-handed poses, like Unity's",
    "mirrored": "cameras of pictures mirrored left to right",
    "upside-down": "cameras of upside-down pictures",
    "xyzw": "quaternions in the order x y z w",
    "wxyz": "quaternions in the order w x y z",
    SQUARE: "cameras with square pixels, fy = fx",
    "by-number": "poses in the order of the numbers in the names",
    "by-name": "poses in the alphabetical order of the names",
    "next": "poses that are listed one image too late",
    "previous": "poses that are listed one image too early",
    EXIF: "cameras of pictures turned as their EXIF orientation says",
}
WORDS = (STATED, *MEANING)
Stated = tuple[str, str]  # a format's kind of matrix, and opencv or opengl


def readings(stated: Stated) -> list[str]:
    """All readings except the stated one, the simplest first."""
    kinds = ["", *(kind for kind in MATRICES if kind != stated[0])]
    other = "opengl" if stated[1] == "opencv" else "opencv"
    odd = ["left-handed", "mirrored", "upside-down"]
    axes = ["", other, *odd, *(f"{name} {other}" for name in odd)]
    several = (" ".join(filter(None, words)) for words in product(["", *QUATERNIONS], axes, kinds))
    every = [*filter(None, several), SQUARE, *ORDERS, EXIF]
    return sorted(every, key=lambda reading: reading.count(" "))


def read_as(
    image_files: Sequence[ImageFile], reading: str, stated: Stated, folder: Path = Path()
) -> list[ImageFile]:
    """The images of all splits of a scene in a folder, with the cameras of a reading."""
    words, cameras = reading.split(), [image_file.camera for image_file in image_files]
    if {*words} & {*MATRICES, *AXES, *QUATERNIONS}:
        cameras = [_posed(camera, words, stated) for camera in cameras]
    if SQUARE in words:
        cameras = [replace(camera, fy=camera.fx) for camera in cameras]
    if EXIF in words:
        turns = [exif_turns(folder / image_file.name) for image_file in image_files]
        cameras = [_rolled(camera, n) for camera, n in zip(cameras, turns, strict=True)]
    text = sorted(range(len(cameras)), key=lambda i: image_files[i].name)
    counted = sorted(text, key=lambda i: natural(image_files[i].name))
    orders = {
        "by-number": (counted, text),
        "by-name": (text, counted),
        "next": (counted, counted[1:] + counted[:1]),
        "previous": (counted, counted[-1:] + counted[:-1]),
    }
    for word in filter(orders.get, dict.fromkeys(words)):
        pose = {i: cameras[j].pose for i, j in zip(*orders[word], strict=True)}
        cameras = [replace(camera, pose=pose[i]) for i, camera in enumerate(cameras)]
    return [
        replace(image_file, camera=camera)
        for image_file, camera in zip(image_files, cameras, strict=True)
    ]


def _posed(camera, words, stated):
    """The camera that the same numbers give in another reading, its world mirrored if necessary."""
    flips = np.diag([1, -1, -1]) if stated[1] == "opengl" else np.eye(3)
    axes, last = camera.pose[:, :3] @ flips, camera.eye
    if stated[0] == "world-to-camera":
        axes, last = axes.T, -axes.T @ last
    for word in {*words} & {*QUATERNIONS}:
        numbers = np.roll(Rotation.from_matrix(axes).as_quat(), QUATERNIONS[word])
        axes = Rotation.from_quat(numbers).as_matrix()
    leads_to_world, is_centre = MATRICES[next(filter(MATRICES.get, words), stated[0])]
    axes = axes if leads_to_world else axes.T
    signs = np.prod([(1, 1, 1), *(AXES[word] for word in words if word in AXES)], axis=0)
    pose = np.column_stack([axes @ flips * signs, last if is_centre else -axes @ last])
    pose[0] *= np.sign(np.linalg.det(pose[:, :3]))
    # turning or mirroring a picture moves a principal point that is not in its middle
    cx = camera.width - camera.cx if {"mirrored", "upside-down"} & {*words} else camera.cx
    cy = camera.height - camera.cy if "upside-down" in words else camera.cy
    return replace(camera, pose=pose, cx=cx, cy=cy)


def _rolled(camera, turns):
    """The camera of a stored picture, given that of the picture turned clockwise by `turns`
    quarters.
    """
    for _ in range(turns if turns == 2 or camera.width == camera.height else 0):
        right, down, forward, eye = camera.pose.T
        pose = np.column_stack([down, -right, forward, eye])
        lens = camera.fy, camera.fx, camera.cy, camera.width - camera.cx
        camera = Camera(pose, *lens, camera.height, camera.width)
    return camera
