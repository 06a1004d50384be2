"""Small scenes on disk for the tests of training and of the command line."""

import json

import numpy as np
from PIL import Image

from pp_cl.engine.camera import Camera


def ring_cameras(n, size, distance=4.0, field_of_view=0.7):
    """n cameras on two rings around the origin, looking at it."""
    focal = 0.5 * size / np.tan(0.5 * field_of_view)
    eyes = [
        distance * np.array([np.cos(a) * np.cos(h), np.sin(a) * np.cos(h), np.sin(h)])
        for a, h in zip(
            np.linspace(0, 2 * np.pi, n, endpoint=False), np.tile([0.2, 0.7], n)[:n], strict=True
        )
    ]
    return [Camera.look_at(eye, (0, 0, 0), fx=focal, width=size, height=size) for eye in eyes]


def ball_image(camera, radius=0.8):
    """(H, W, 4) uint8 image of a ball at the origin whose colour varies with the surface
    position.
    """
    rays = camera.rays()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    b = rays @ camera.eye
    disc = b**2 - (camera.eye @ camera.eye - radius**2)
    surface = camera.eye + rays * (-b - np.sqrt(np.maximum(disc, 0)))[..., None]
    return np.rint(255 * np.dstack([ball_colour(surface), disc > 0])).astype(np.uint8)


def ball_colour(surface):
    """(..., 3) in [0, 1]: the ball's colour at positions on its surface."""
    return 0.5 + 0.4 * np.sin(4 * surface + [0, 1, 2])


def write_ball_scene(folder, views=8, size=48, splits=("train", "test")):
    """A NeRF-synthetic folder of the ball; returns the folder as text."""
    folder.mkdir(parents=True, exist_ok=True)
    for split in splits:
        (folder / split).mkdir(exist_ok=True)
        frames = []
        cameras = ring_cameras(views, size)
        if split != "train":
            cameras = ring_cameras(37, size)[5::16][:2]  # neither is a training camera
        for i, camera in enumerate(cameras):
            Image.fromarray(ball_image(camera)).save(folder / split / f"r_{i}.png")
            pose = np.vstack([camera.pose * [1, -1, -1, 1], [0, 0, 0, 1]])  # OpenGL axes
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        (folder / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": 0.7, "frames": frames})
        )
    return str(folder)


def move_scene(folder, by, unit=None):
    """Move all cameras of a NeRF-synthetic folder by (3,). unit: first round their eyes to whole
    units of this power of two, so that moves by whole units are exact.
    """
    for file in folder.glob("transforms_*.json"):
        data = json.loads(file.read_text())
        for frame in data["frames"]:
            pose = np.array(frame["transform_matrix"])
            if unit:
                pose[:3, 3] = unit * np.rint(pose[:3, 3] / unit)
            pose[:3, 3] += by
            frame["transform_matrix"] = pose.tolist()
        file.write_text(json.dumps(data))
