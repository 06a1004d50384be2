"""How the cameras of a scene may be meant, other than its format has it: what programs and people
get wrong. A reading is some of the words below, by which `axes` of pp_cl.json names it.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl.engine.camera import Camera
from pp_cl.files.image import exif_turns
from pp_cl.scene.found import natural
from pp_cl.scene.image_file import ImageFile

STATED = "stated"  # the cameras are right as the format has them
# {kind of matrix: (whether its rotation leads to the world, whether its last column is the centre)}
MATRICES = {
    "camera-to-world": (True, True),
    "world-to-camera": (False, False),
    "centres": (False, True),
    "translations": (True, False),
}
# {axes of a camera, compared with those of the format: signs of x, y, z}
AXES = {
    "opencv": (1, -1, -1),
    "opengl": (1, -1, -1),
    "left-handed": (1, 1, -1),
    "mirrored": (-1, 1, 1),
    "upside-down": (-1, -1, 1),
}
QUATERNIONS = {"xyzw": 1, "wxyz": -1}  # by how many places numbers move to x, y, z, w
PIXELS = ("fy=fx", "fx=fy")
ORDERS = ("by-number", "by-name", "next", "previous")
TURNED = "exif"
WORDS = (STATED, *MATRICES, *AXES, *QUATERNIONS, *PIXELS, *ORDERS, TURNED)
MEANING = {
    "camera-to-world": "camera-to-world matrices",
    "world-to-camera": "world-to-camera matrices",
    "centres": "rotations from the world with the cameras' centres in place of the translations",
    "translations": "rotations of the cameras with translations in place of the centres",
    "opencv": "matrices with OpenCV's axes (y down, z forward)",
    "opengl": "matrices with OpenGL's axes (y up, z backward)",
    "left-handed": "left-handed poses (Unity's)",
    "mirrored": "cameras of pictures that are mirrored left to right",
    "upside-down": "cameras of pictures that are upside down",
    "xyzw": "quaternions in the order x y z w",
    "wxyz": "quaternions in the order w x y z",
    "fy=fx": "cameras with square pixels (fy = fx)",
    "fx=fy": "cameras with square pixels (fx = fy)",
    "by-number": "poses in the order of the numbers in the images' names",
    "by-name": "poses in the order of the images' names as text",
    "next": "poses of the images after them",
    "previous": "poses of the images before them",
    TURNED: "cameras of pictures turned as their EXIF orientation says",
}
# of cameras: a pair of kinds of matrix and of axes as a format states them
Stated = tuple[str, str]


def readings(stated: Stated) -> list[str]:
    """All readings but the stated one, the simplest first."""
    kinds = ["", *(kind for kind in MATRICES if kind != stated[0])]
    other = "opengl" if stated[1] == "opencv" else "opencv"
    signs = ["", other, "left-handed", "mirrored", "upside-down"]
    signs += [f"{one} {other}" for one in ("left-handed", "mirrored", "upside-down")]
    some = product(["", *QUATERNIONS], signs, kinds)
    found = [*(" ".join(filter(None, words)) for words in some), *PIXELS, *ORDERS, TURNED]
    return sorted(filter(None, found), key=lambda reading: reading.count(" "))


def read_as(
    image_files: Sequence[ImageFile], reading: str, stated: Stated, folder: Path = Path()
) -> list[ImageFile]:
    """The images of a scene in a folder, of all splits, with the cameras that a reading gives them;
    those that it changes in nothing are the same objects.
    """
    words = reading.split()
    cameras = [_read_as(one.camera, words, stated) for one in image_files]
    if TURNED in words:
        turns = [exif_turns(folder / one.name) for one in image_files]
        cameras = [_rolled(c, n) for c, n in zip(cameras, turns, strict=True)]
    if any(word in ORDERS for word in words):
        text = sorted(range(len(image_files)), key=lambda i: image_files[i].name)
        counted = sorted(text, key=lambda i: natural(image_files[i].name))
        to, of = {
            "by-number": (counted, text),
            "by-name": (text, counted),
            "next": (counted, counted[1:] + counted[:1]),
            "previous": (counted, counted[-1:] + counted[:-1]),
        }[words[0]]
        for i, j in zip(to, of, strict=True):
            if i != j:
                cameras[i] = replace(cameras[i], pose=image_files[j].camera.pose)
    return [replace(o, camera=camera) for o, camera in zip(image_files, cameras, strict=True)]


def _rolled(camera, turns):
    """The camera of the picture as it is stored, of that as it is shown, by quarter turns."""
    for _ in range(turns if turns == 2 or camera.width == camera.height else 0):
        right, down, forward, eye = camera.pose.T
        pose = np.column_stack([down, -right, forward, eye])
        lens = camera.fy, camera.fx, camera.cy, camera.width - camera.cx
        camera = Camera(pose, *lens, camera.height, camera.width)
    return camera


def _read_as(camera: Camera, words: Sequence[str], stated: Stated) -> Camera:
    """The camera that the same numbers of a file give, the world mirrored if it is left-handed."""
    if not {*words} & {*MATRICES, *AXES, *QUATERNIONS}:
        return _with_square_pixels(camera, words)
    kind, flips = stated[0], np.diag([1, -1, -1]) if stated[1] == "opengl" else np.eye(3)
    axes, last = camera.pose[:, :3] @ flips, camera.eye
    if kind == "world-to-camera":
        axes, last = axes.T, -axes.T @ last
    for word in words:
        if word in QUATERNIONS:
            quaternion = np.roll(Rotation.from_matrix(axes).as_quat(), QUATERNIONS[word])
            axes = Rotation.from_quat(quaternion).as_matrix()
        kind = word if word in MATRICES else kind
    leads_to_world, is_centre = MATRICES[kind]
    axes = axes if leads_to_world else axes.T
    eye = last if is_centre else -axes @ last
    signs = np.prod([AXES[word] for word in words if word in AXES], axis=0) * np.ones(3)
    pose = np.column_stack([axes @ flips * signs, eye])
    pose[0] *= np.sign(np.linalg.det(pose[:, :3]))
    camera = replace(camera, pose=pose)
    if "mirrored" in words or "upside-down" in words:
        camera = replace(camera, cx=camera.width - camera.cx)
    if "upside-down" in words:
        camera = replace(camera, cy=camera.height - camera.cy)
    return _with_square_pixels(camera, words)


def _with_square_pixels(camera, words):
    for word in PIXELS:
        if word in words and camera.fx != camera.fy:
            camera = replace(camera, **{word[:2]: getattr(camera, word[3:])})
    return camera
