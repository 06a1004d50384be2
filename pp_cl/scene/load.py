"""Scenes: photographs of one object, with cameras and masks, from any format that READERS knows."""

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene.camera import Camera
from pp_cl.scene.readers import transforms
from pp_cl.scene.views import View

# One module per format. FILES names the files it reads, recognises(folder) tells whether a folder
# holds such files, splits(folder) names its splits, and read_split(folder, split) gives [(image
# path relative to the folder, Camera, (near, far) or None)] without reading pixels.
READERS = (transforms,)

Frame = tuple[str, Camera, tuple[float, float] | None]
Item = TypeVar("Item")


@dataclass(frozen=True)
class Scene:
    """Views of one object, all of one size.

    folder: None for a scene that the program makes itself. splits: views by split name ("train",
    "val", "test"). Either all views have a depth range or none has.
    """

    name: str
    folder: Path | None
    splits: dict[str, list[View]]

    def reduced(self, downscale: int) -> "Scene":
        """The same scene, its images reduced `downscale` times. Raises UserError as View.reduced
        does.
        """
        splits = {
            split: [view.reduced(downscale) for view in views]
            for split, views in self.splits.items()
        }
        return replace(self, splits=splits)


def evenly(items: Sequence[Item], most: int | None) -> list[Item]:
    """At most `most` of the items, spread evenly, the first among them; None: all."""
    n = len(items)
    return list(items) if most is None or n <= most else [items[n * i // most] for i in range(most)]


def find_reader(path: str | Path) -> ModuleType:
    """The module of READERS for a folder. Raises UserError where it holds no scene."""
    folder = Path(path)
    if not folder.is_dir():
        raise UserError(
            f"{folder}: no such folder; give a folder with {_known_files()}, or the word demo"
        )
    reader = next((reader for reader in READERS if reader.recognises(folder)), None)
    if reader is None:
        raise UserError(f"{folder}: no scene in it; it needs {_known_files()}")
    return reader


def load_scene(
    path: str | Path, splits: Iterable[str] = ("train",), most: int | None = None
) -> Scene:
    """Scene of the given splits from a folder, not reduced; a progress bar shows on a terminal.

    most: views to read of each split, spread evenly; None: all. Raises UserError naming the file,
    and the key where there is one, for whatever is missing, broken or contradictory.
    """
    reader, folder = find_reader(path), Path(path)
    frames = {split: evenly(reader.read_split(folder, split), most) for split in splits}
    everything = [frame for listed in frames.values() for frame in listed]
    _check_alike(folder, everything)
    images = iter(_read_images([folder / name for name, _, _ in everything]))
    views = {
        split: [View(name, camera, next(images), near_far) for name, camera, near_far in listed]
        for split, listed in frames.items()
    }
    return Scene(folder.resolve().name, folder, views)


def _known_files() -> str:
    return " or ".join(reader.FILES for reader in READERS)


def _check_alike(folder, frames):
    """Raise UserError if images differ in size, or if only some frames have a depth range."""
    first_name, first, first_range = frames[0]
    for name, camera, near_far in frames:
        if (camera.width, camera.height) != (first.width, first.height):
            raise UserError(
                f"{folder / name}: {camera.width}x{camera.height} pixels, but {folder / first_name}"
                f" has {first.width}x{first.height}; all views must have one size"
            )
        if (near_far is None) != (first_range is None):
            raise UserError(
                f"{folder}: near and far are given for only one of {first_name} and {name}; "
                "give them for all views or for none"
            )


def _read_images(paths: Sequence[Path]) -> list[np.ndarray]:
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
