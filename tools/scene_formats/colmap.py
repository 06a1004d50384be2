"""A scene as a sparse model of COLMAP (sparse/0, without points) with images and masks."""

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl.engine.views import View
from tools.scene_formats.common import number, ordered, write_mask, write_rgb

PINHOLE = 1  # COLMAP's number of the model


def write(folder: Path, splits: dict[str, list[View]], binary: bool = True) -> None:
    """Write the views; a camera for each, model PINHOLE. Raises UserError for splits other than
    those that readers hold out.
    """
    views = ordered(splits)
    for i, view in enumerate(views):
        write_rgb(folder / "images" / f"{number(i)}.png", view)
        write_mask(folder / "masks" / f"{number(i)}.png.png", view)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (_write_binary if binary else _write_text)(model, views)


def _pinhole(view):
    camera = view.stored_camera
    return camera.fx, camera.fy, camera.cx, camera.cy


def _pose(view):
    """qw, qx, qy, qz, tx, ty, tz: world to camera."""
    rotation = view.stored_camera.pose[:, :3].T
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return w, x, y, z, *(-rotation @ view.stored_camera.eye)


def _write_binary(model, views):
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for i, view in enumerate(views):
        size = view.stored_camera.width, view.stored_camera.height
        cameras.append(struct.pack("<IiQQ4d", i + 1, PINHOLE, *size, *_pinhole(view)))
        images.append(struct.pack("<I7dI", i + 1, *_pose(view), i + 1))
        images.append(f"{number(i)}.png".encode() + b"\0" + struct.pack("<Q", 0))
    for name, parts in (("cameras", cameras), ("images", images), ("points3D", [bytes(8)])):
        (model / f"{name}.bin").write_bytes(b"".join(parts))


def _write_text(model, views):
    cameras = ["# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = [
        "# Image list: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[]",
    ]
    for i, view in enumerate(views):
        size = f"{view.stored_camera.width} {view.stored_camera.height}"
        cameras.append(f"{i + 1} PINHOLE {size} {_text(_pinhole(view))}")
        images += [f"{i + 1} {_text(_pose(view))} {i + 1} {number(i)}.png", ""]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", ["# none"])):
        (model / f"{name}.txt").write_text("\n".join(lines) + "\n")


def _text(values):
    return " ".join(repr(float(v)) for v in np.asarray(values, np.float64))
