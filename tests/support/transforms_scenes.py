"""Valid and invalid scenes in the format of NeRF-synthetic, with random images."""

import json
import os

import numpy as np
from support.refused import refusing

from pp_cl.engine.camera import look_at
from pp_cl.files.image import write_png
from pp_cl.scene.listing import find_reader
from pp_cl.scene.load import load_scene

SIZE = (24, 18)  # width, height of the images written here


def opengl_pose(eye):
    """4x4 camera-to-world, in OpenGL axes, of a camera looking from `eye` to the origin, z up."""
    return np.vstack([look_at(eye, (0, 0, 0)) * [1, -1, -1, 1], [0, 0, 0, 1]])


def write_scene(folder, split="train", count=3, edit=None):
    """Write a NeRF-synthetic split of `count` random views; edit(data) changes the JSON data before
    they are written. Returns the data.
    """
    rng = np.random.default_rng(3)
    frames = []
    for i in range(count):
        write_png(
            folder / f"{split}_{i}.png", rng.integers(0, 256, (SIZE[1], SIZE[0], 4), np.uint8)
        )
        angle = 2 * np.pi * i / count
        matrix = opengl_pose([3 * np.cos(angle), 3 * np.sin(angle), 1.2])
        frames.append({"file_path": f"./{split}_{i}", "transform_matrix": matrix.tolist()})
    data = {"camera_angle_x": 0.7, "frames": frames}
    if edit:
        edit(data)
    (folder / f"transforms_{split}.json").write_text(json.dumps(data))
    return data


def train_views(folder, **keys):
    """Views of a new scene with `keys` added to every frame."""
    write_scene(folder, edit=lambda data: [frame.update(keys) for frame in data["frames"]])
    return load_scene(folder).splits["train"]


def escape(file):
    """Move a file out of its scene's folder and leave a symbolic link to it."""
    above = file.parents[2]
    outside = above / f"outside-{len(os.listdir(above))}{file.suffix}"
    file.rename(outside)
    file.symlink_to(outside)


def left_out(folder, *words, split="train"):
    """Assert that views of a split are left out, the first with an error that has all words."""
    gone: list = []
    assert find_reader(folder).read_split(folder, split, gone)
    with refusing(*words):
        raise gone[0][1]


def refused(folder, *words, splits=("train",)):
    """Assert that loading fails with one line that has all the words."""
    with refusing(*words):
        load_scene(folder, splits)
