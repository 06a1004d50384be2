"""Reader of COLMAP's sparse models: cameras and images, text or binary, beside a folder of images
and, for objects, one of masks.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl.errors import UserError
from pp_cl.files.image import image_size
from pp_cl.scene.camera import Camera
from pp_cl.scene.distortion import Distortion
from pp_cl.scene.readers.colmap_model import Image, Lens, is_model, read_model
from pp_cl.scene.readers.common import (
    SPLITS,
    fail_at,
    find_image,
    find_mask,
    hold_out,
    listing,
)
from pp_cl.scene.views import Photograph

FILES = "a sparse model of COLMAP beside images"
PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
IMAGES, MASKS = "images", "masks"


def recognises(folder: Path) -> bool:
    """True if the folder has a model in one of the usual places."""
    return _model_folder(folder) is not None


def splits(folder: Path) -> list[str]:
    """Train and test: COLMAP knows no splits."""
    return SPLITS


def read_split(folder: Path, split: str) -> list[Photograph]:
    """The photographs of a split: test is every eighth in the order of their names.

    An image's mask is masks/NAME.png, as COLMAP has it, or masks/NAME with any ending of an image;
    with a folder of masks, every image needs one. Raises UserError naming the file, and the image.
    """
    model = _model_folder(folder)
    lenses, images = read_model(model)
    ordered = sorted(images, key=lambda image: image.name)
    return [
        _photograph(folder, model, image, lenses[image.camera])
        for image in listing(hold_out(ordered, split))
    ]


def _model_folder(folder):
    for place in PLACES:
        if any(is_model(folder / place, suffix) for suffix in (".bin", ".txt")):
            return folder / place
    return None


def _photograph(folder, model, image: Image, lens: Lens):
    fail = fail_at(model, image.name)
    name = find_image(folder, f"{IMAGES}/{image.name}", fail)
    size = image_size(folder / name)
    if size != (lens.width, lens.height):
        raise fail(
            f"has {size[0]}x{size[1]} pixels, but its camera {lens.width}x{lens.height}; restore"
            " the images that COLMAP was given"
        )
    fx, fy, cx, cy, distortion = _intrinsics(folder, model, lens)
    w, x, y, z = image.rotation
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.column_stack([rotation, -rotation @ image.translation])
    camera = Camera(pose, fx, fy, cx, cy, *size)
    mask = find_mask(folder, MASKS, image.name, fail)
    return Photograph(name, camera, mask=mask, distortion=distortion)


def _intrinsics(folder, model, lens):
    """(fx, fy, cx, cy, Distortion). Raises UserError for a model that is not one of OpenCV's."""
    p = lens.parameters
    if lens.model == "SIMPLE_PINHOLE":
        found = p[0], p[0], p[1], p[2], Distortion()
    elif lens.model == "PINHOLE":
        found = *p, Distortion()
    elif lens.model in ("SIMPLE_RADIAL", "RADIAL"):
        found = p[0], p[0], p[1], p[2], Distortion(*p[3:])
    elif lens.model == "OPENCV":
        found = *p[:4], Distortion(*p[4:])
    else:
        raise UserError(
            f"{model}: camera model {lens.model} is not read; convert with `colmap"
            f" image_undistorter --image_path {folder / IMAGES} --input_path {model} --output_path"
            " NEW` and give NEW"
        )
    return found
