"""Scenes: photographs of one object, with cameras and masks, from any format that READERS knows."""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene.distortion import undistort
from pp_cl.scene.identity import pixel_digest
from pp_cl.scene.masks import AS_GIVEN, MaskRule
from pp_cl.scene.photograph import Photograph
from pp_cl.scene.readers import co3d, colmap, llff, neus, nsvf, transforms
from pp_cl.scene.views import View

# One module per format. FILES names the files it reads, recognises(folder) tells whether a folder
# holds such files, splits(folder) names its splits, and read_split(folder, split) gives a list of
# Photograph without reading pixels. The first that recognises a folder reads it.
READERS = (transforms, co3d, neus, nsvf, colmap, llff)

LEAST_FOCAL, MOST_FOCAL = 1e-2, 1e7  # pixels; docs/scene_scale.md says what is measured

Item, Made = TypeVar("Item"), TypeVar("Made")


@dataclass(frozen=True)
class Scene:
    """Views of one object.

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
    if not os.access(folder, os.R_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be read; check its permissions")
    reader = next((reader for reader in READERS if reader.recognises(folder)), None)
    if reader is None:
        raise UserError(f"{folder}: no scene in it; it needs {_known_files()}")
    return reader


def load_scene(
    path: str | Path,
    splits: Iterable[str] = ("train",),
    most: int | None = None,
    masks: MaskRule = AS_GIVEN,
) -> Scene:
    """Scene of the given splits from a folder, not reduced; a progress bar shows on a terminal.

    most: views to read of each split, spread evenly; None: all. Raises UserError naming the file,
    and the key where there is one, for whatever is missing, broken or contradictory.
    """
    reader, folder = find_reader(path), Path(path)
    listed = {s: evenly(list_photographs(reader, folder, s), most) for s in splits}
    everything = [photograph for photographs in listed.values() for photograph in photographs]
    _check_alike(folder, everything)
    images = iter(_on_all_cores(lambda one: _read_image(folder, one, masks), everything))
    views = {
        split: [_view(one, *next(images)) for one in photographs]
        for split, photographs in listed.items()
    }
    return Scene(folder.resolve().name, folder, views)


def list_photographs(reader: ModuleType, folder: Path, split: str) -> list[Photograph]:
    """The photographs of a split that a module of READERS lists. Raises UserError where there are
    none, and for a camera that shows nothing in float32.
    """
    photographs = reader.read_split(folder, split)
    if not photographs:
        raise UserError(f"{folder}: split {split} has no photographs; add some")
    for one in photographs:
        _check_lens(folder / one.name, one.camera)
    return photographs


def _check_lens(image, camera):
    """Raise UserError for a camera that shows nothing in float32."""
    focal, middle = (camera.fx, camera.fy), (camera.cx, camera.cy)
    if not LEAST_FOCAL <= min(focal) <= max(focal) <= MOST_FOCAL:
        what, least = f"focal lengths of {focal[0]:.3g} and {focal[1]:.3g}", LEAST_FOCAL
    elif not -MOST_FOCAL <= min(middle) <= max(middle) <= MOST_FOCAL:
        what, least = f"its principal point at {middle[0]:.3g}, {middle[1]:.3g}", -MOST_FOCAL
    else:
        return
    raise UserError(
        f"{image}: its camera has {what} pixels, which must be {least:g} to {MOST_FOCAL:g}; correct"
        " the scene's file of cameras"
    )


def _view(photograph, image, digest):
    return View(photograph.name, photograph.camera, image, photograph.depth_range, digest=digest)


def _known_files() -> str:
    return " or ".join(reader.FILES for reader in READERS)


def _check_alike(folder, photographs):
    """Raise UserError if only some photographs have a depth range."""
    first = photographs[0]
    for one in photographs:
        if (one.depth_range is None) != (first.depth_range is None):
            raise UserError(
                f"{folder}: near and far are given for only one of {first.name} and {one.name}; "
                "give them for all views or for none"
            )


def _read_image(folder, photograph, masks):
    """((H, W, 4) uint8 straight RGBA: the image with its mask, freed of distortion, the digest of
    its pixels). Raises UserError.
    """
    image = read_rgba(folder / photograph.name)
    image = masks.apply(image, photograph.name, photograph.mask and folder / photograph.mask)
    if photograph.distortion.folds(photograph.camera):
        raise UserError(
            f"{folder / photograph.name}: its distortion coefficients fold the image over; correct"
            " them, or undistort the images with the program that found them"
        )
    if photograph.distortion:
        image = undistort(image, photograph.camera, photograph.distortion)
    return image, pixel_digest(image)


def _on_all_cores(read: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
    """[read(item)] in order. Raises the UserError of the first that fails."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(
            tqdm(
                pool.map(read, items),
                "reading images",
                len(items),
                unit="image",
                leave=False,
                disable=None,
            )
        )
