"""Scenes: photographs of one object, with cameras and masks, from any format that FORMATS knows."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pp_cl import scene_transforms
from pp_cl.camera import Camera
from pp_cl.errors import UserError
from pp_cl.image import read_rgba

# One module per format. FILES says what it reads, recognises(folder) tells whether a folder holds that,
# read_split(folder, split) gives [(image path relative to the folder, Camera)] without reading pixels, and
# published(name, cameras) the rows of the literature for a benchmark scene.
FORMATS = (scene_transforms,)

# Alpha (0 to 255) above which a pixel belongs to the object. Low, since a mask that is too large costs points but one that
# is too small carves the object away, translucent parts first; not 0, because the reconstruction filter of NeRF-synthetic
# leaves alphas of 1 and 2 as far as 3 pixels from the object, and masks that once were JPEG carry noise of that size
# around their edge (NeRD's captures). Above 8 both end within 1.5 pixels of alpha 0.5.
MASK_THRESHOLD = 8

MIN_SIDE = 16  # pixels of a reduced image: SSIM's window of 11 and the U-Net's two poolings need room


@dataclass(frozen=True, eq=False)
class View:
    """One photograph.

    name: path of the image relative to the scene's folder. camera: of the full stored resolution; near and far are NaN
    while unknown. image: (H, W, 4) uint8, straight RGBA (alpha 255 everywhere if the file has none); not to be changed.
    """

    name: str
    camera: Camera
    image: np.ndarray

    @property
    def has_depth_range(self):
        """True if near and far are known."""
        return bool(np.isfinite(self.camera.near) and np.isfinite(self.camera.far))


@dataclass
class Scene:
    """Views of one object, all of one size.

    folder: None for a scene that the program makes itself. splits: views by split name ("train", "val", "test").
    depth_range_stored: all cameras have near and far; else none has. published: {method: {"psnr", "ssim", "lpips"}}.
    """

    name: str
    folder: Path | None
    splits: dict[str, list[View]]
    depth_range_stored: bool
    published: dict = field(default_factory=dict)


def load_scene(path, splits=("train",)):
    """Scene of the given splits from a folder; a progress bar shows on a terminal.

    Raises UserError naming the file, and the key where there is one, for whatever is missing, broken or contradictory.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give a folder with {_known_files()}, or the word demo")
    reader = next((f for f in FORMATS if f.recognises(folder)), None)
    if reader is None:
        raise UserError(f"{folder}: no scene in it; it needs {_known_files()}")
    listed = {split: reader.read_split(folder, split) for split in splits}
    everything = [entry for entries in listed.values() for entry in entries]
    depth_range_stored = _check_alike(folder, everything)
    images = iter(_read_images([folder / name for name, _ in everything]))
    views = {split: [View(name, camera, next(images)) for name, camera in entries] for split, entries in listed.items()}
    name = folder.resolve().name
    return Scene(name, folder, views, depth_range_stored, reader.published(name, [camera for _, camera in everything]))


def _known_files():
    return " or ".join(reader.FILES for reader in FORMATS)


def _check_alike(folder, entries):
    """Whether the cameras have depth ranges. Raises UserError if only some have, or if sizes differ."""
    first_name, first = entries[0]
    for name, camera in entries:
        if (camera.width, camera.height) != (first.width, first.height):
            raise UserError(f"{folder / name}: {camera.width}x{camera.height} pixels, but {folder / first_name} has "
                            f"{first.width}x{first.height}; all views must have one size")
        if np.isnan(camera.near) != np.isnan(first.near):
            raise UserError(f"{folder}: near and far are given for only one of {first_name} and {name}; "
                            "give them for all views or for none")
    return bool(np.isfinite(first.near))


def _read_images(paths):
    """[read_rgba(path)] in order, on all cores. Raises the UserError of the first file that cannot be read."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(tqdm(pool.map(read_rgba, paths), "reading images", len(paths), unit="image", leave=False, disable=None))


def reduced_camera(view, downscale):
    """Camera of a view reduced `downscale` times.

    Raises UserError unless that is a whole number that leaves at least MIN_SIDE pixels each way.
    """
    camera = view.camera
    most = min(camera.width, camera.height) // MIN_SIDE
    if most == 0:
        raise UserError(f"{view.name}: {camera.width}x{camera.height} pixels; at least {MIN_SIDE}x{MIN_SIDE} are needed")
    if not isinstance(downscale, int) or not 1 <= downscale <= most:
        raise UserError(f"--downscale {downscale}: not a whole number from 1 to {most}, the range for the "
                        f"{camera.width}x{camera.height} pixels of {view.name}")
    return camera.downscaled(downscale)


def object_box(views, downscale, margin):
    """[(x0, y0, x1, y1)] for each view: the pixels of the reduced image, half-open, that show the object.

    margin: reduced pixels added on every side, as far as the image goes. A view without object gets its whole image.
    """
    return [_object_box(view, downscale, margin) for view in views]


def _object_box(view, downscale, margin):
    camera = reduced_camera(view, downscale)
    mask = view.image[:camera.height * downscale, :camera.width * downscale, 3] > MASK_THRESHOLD
    x0, x1 = _extent(mask.any(axis=0), downscale, margin)
    y0, y1 = _extent(mask.any(axis=1), downscale, margin)
    return x0, y0, x1, y1


def _extent(occupied, downscale, margin):
    """(first, last + 1) reduced pixel of the occupied stored columns or rows; the whole length if there are none."""
    size, found = len(occupied) // downscale, np.flatnonzero(occupied) // downscale
    if found.size == 0:
        return 0, size
    return max(int(found[0]) - margin, 0), min(int(found[-1]) + 1 + margin, size)
