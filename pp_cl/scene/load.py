"""Scenes: photographs of one object, with cameras and masks, from any format that FORMATS knows."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene.readers import transforms as scene_transforms
from pp_cl.scene.views import View

# One module per format. FILES says what it reads, recognises(folder) tells whether a folder holds
# that, read_split(folder, split) gives [(image path relative to the folder, Camera)] without
# reading pixels, and published(name, cameras) the rows of the literature for a benchmark scene.
FORMATS = (scene_transforms,)


@dataclass
class Scene:
    """Views of one object, all of one size.

    folder: None for a scene that the program makes itself. splits: views by split name ("train",
    "val", "test"). depth_range_stored: all cameras have near and far; else none has. published:
    {method: {"psnr", "ssim", "lpips"}}.
    """

    name: str
    folder: Path | None
    splits: dict[str, list[View]]
    depth_range_stored: bool
    published: dict = field(default_factory=dict)


def load_scene(path, splits=("train",)):
    """Scene of the given splits from a folder; a progress bar shows on a terminal.

    Raises UserError naming the file, and the key where there is one, for whatever is missing,
    broken or contradictory.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise UserError(
            f"{folder}: no such folder; give a folder with {_known_files()}, or the word demo"
        )
    reader = next((f for f in FORMATS if f.recognises(folder)), None)
    if reader is None:
        raise UserError(f"{folder}: no scene in it; it needs {_known_files()}")
    listed = {split: reader.read_split(folder, split) for split in splits}
    everything = [entry for entries in listed.values() for entry in entries]
    depth_range_stored = _check_alike(folder, everything)
    images = iter(_read_images([folder / name for name, _ in everything]))
    views = {
        split: [View(name, camera, next(images)) for name, camera in entries]
        for split, entries in listed.items()
    }
    name = folder.resolve().name
    return Scene(
        name,
        folder,
        views,
        depth_range_stored,
        reader.published(name, [camera for _, camera in everything]),
    )


def _known_files():
    return " or ".join(reader.FILES for reader in FORMATS)


def _check_alike(folder, entries):
    """Whether the cameras have depth ranges. Raises UserError if only some have, or if sizes
    differ.
    """
    first_name, first = entries[0]
    for name, camera in entries:
        if (camera.width, camera.height) != (first.width, first.height):
            raise UserError(
                f"{folder / name}: {camera.width}x{camera.height} pixels, but {folder / first_name}"
                f" has {first.width}x{first.height}; all views must have one size"
            )
        if np.isnan(camera.near) != np.isnan(first.near):
            raise UserError(
                f"{folder}: near and far are given for only one of {first_name} and {name}; "
                "give them for all views or for none"
            )
    return bool(np.isfinite(first.near))


def _read_images(paths):
    """[read_rgba(path)] in order, on all cores. Raises the UserError of the first file that cannot
    be read.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(
            tqdm(
                pool.map(read_rgba, paths),
                "reading images",
                len(paths),
                unit="image",
                leave=False,
                disable=None,
            )
        )
