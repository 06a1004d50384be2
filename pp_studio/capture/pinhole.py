"""The images of a scene: photographs free of the distortion of their lens."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from PIL import Image

from pp_cl import track
from pp_cl.engine import Device
from pp_cl.errors import UserError
from pp_cl.files import atomic_file, read_rgba, write_png
from pp_cl.scene import ImageFile, undistort
from pp_studio.capture.frames import QUALITY
from pp_studio.capture.packages import needed

DECODED, MOST_DECODED = 18, 3 * 2**28  # bytes of a pixel that is decoded, and of all at once


def write_images(dev: Device, frames: Path, images: Path, image_files: Sequence[ImageFile]) -> int:
    """Write those photographs that are not there yet, free of distortion, to the folder `images`:
    each under the name, in the format and for the camera that it has; returns their number.

    frames: the folder of the photographs as the lens has them. Raises UserError for one that its
    distortion folds over, and as read_rgba() and write_png() do.
    """
    for one in image_files:
        if one.lens.folds(one.camera):
            raise UserError(
                f"{frames / Path(one.name).name}: the lens that was found folds the image over;"
                " take more photographs with more overlap, and do not zoom"
            )
    images.mkdir(exist_ok=True)
    left = [one for one in image_files if not (images / Path(one.name).name).is_file()]
    lock = Lock()  # one of several threads uses the device

    def write(one):
        name = Path(one.name).name
        image = read_rgba(frames / name)
        if one.lens:
            with lock:
                image = undistort(dev, image, one.camera, one.lens)
        if name.endswith(".png"):
            is_opaque = (image[..., 3] == 255).all()
            write_png(images / name, image[..., :3] if is_opaque else image)
        else:
            with atomic_file(images / name) as file:
                Image.fromarray(image[..., :3]).save(file, "JPEG", **QUALITY)

    most = max(one.camera.width * one.camera.height for one in image_files)
    threads = min(os.cpu_count() or 1, MOST_DECODED // (DECODED * most))
    with ThreadPoolExecutor(max(1, threads)) as pool:
        made = pool.map(write, left)
        list(track(made, "images", "image", len(left)))
    return len(left)


def undistorted_mask(dev: Device, mask: np.ndarray, image_file: ImageFile) -> np.ndarray:
    """(H, W) uint8 mask of a photograph as the lens has it, (H, W) uint8, for its image."""
    if not image_file.lens:
        return mask
    planes = np.dstack([mask] * 4)
    return undistort(dev, planes, image_file.camera, image_file.lens)[..., 3]


def undistort_model(model: Any) -> None:
    """Give pycolmap's model of features.LENS cameras without distortion, and move what its images
    show to where that is without.
    """
    for image in model.images.values():
        lens = image.camera
        focal, cx, cy, _ = lens.params
        directions = lens.cam_from_img(np.array([point.xy for point in image.points2D]))
        for point, place in zip(image.points2D, focal * directions + [cx, cy], strict=True):
            point.xy = place
    for lens in model.cameras.values():
        focal, cx, cy, _ = lens.params
        lens.model, lens.params = needed("pycolmap").CameraModelId.PINHOLE, [focal, focal, cx, cy]
