"""Scenes: photographs of one object, with cameras and masks, from any format that READERS knows."""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from tqdm import tqdm

from pp_cl.errors import UserError, quoted
from pp_cl.files.image import read_rgba
from pp_cl.scene.distortion import undistort
from pp_cl.scene.identity import pixel_digest
from pp_cl.scene.masks import AS_GIVEN, MaskRule
from pp_cl.scene.photograph import Photograph
from pp_cl.scene.readers import co3d, colmap, llff, neus, nsvf, transforms
from pp_cl.scene.readers.common import ENDINGS
from pp_cl.scene.shrink import shrink, shrink_factor
from pp_cl.scene.views import View, check_downscale

# One module per format. FILES names the files it reads, recognises(folder) tells whether a folder
# holds such files, splits(folder) names its splits, and read_split(folder, split) gives a list of
# Photograph without reading pixels. The first that recognises a folder reads it.
READERS = (transforms, co3d, neus, nsvf, colmap, llff)

# Bytes per pixel of what reading takes at its peak, measured with 12 megapixels: decoding and a
# mask, cubic interpolation without distortion, a mask by colour (both in float64)
DECODED, UNDISTORTED, CUT_OUT = 18, 125, 160
READING_BYTES = 3 * 2**28  # of the photographs that are read side by side

LEAST_FOCAL, MOST_FOCAL = 1e-2, 1e7  # pixels; docs/scenes.md says what is measured

NEARBY = 100  # entries of a folder without a scene in which one is looked for

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
    check_folder(folder)
    reader = _reader_of(folder)
    if reader is None:
        raise UserError(f"{folder}: no scene in it{_found_instead(folder)}")
    return reader


def check_folder(folder: Path) -> None:
    """Raise UserError where a scene's folder is missing, no folder, or cannot be read."""
    if folder.is_file():
        raise UserError(
            f"{folder}: is a file; a scene is a folder, maybe {folder.absolute().parent}"
        )
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; SCENE is a folder, or the word demo")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be read; check its permissions")


def _reader_of(folder):
    return next((reader for reader in READERS if reader.recognises(folder)), None)


def _found_instead(folder):
    """What is in a folder without a scene, and where one is, in words."""
    inside = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    for near in (folder.absolute().parent, *filter(Path.is_dir, inside[:NEARBY])):
        if os.access(near, os.R_OK | os.X_OK) and (reader := _reader_of(near)):
            return f"; {near} is one ({reader.FILES}); give that"
    pictures = sum(entry.suffix.lower() in ENDINGS for entry in inside)
    others = [entry.name for entry in inside if entry.suffix.lower() not in ENDINGS]
    found = [f"{pictures} image{'s' * (pictures > 1)}"] * bool(pictures) + [
        quoted(name, 40) for name in others[:3]
    ]
    found = ", ".join(found) + f" and {len(others) - 3} more" * (len(others) > 3)
    return (
        f": {found or 'nothing'}, but no file of cameras that is known, such as"
        " transforms.json or sparse/0; docs/scenes.md has the formats, and how to make cameras"
    )


def load_scene(
    path: str | Path,
    splits: Iterable[str] = ("train",),
    most: int | None = None,
    masks: MaskRule = AS_GIVEN,
    *,
    downscale: int | None = None,
) -> Scene:
    """Scene of the given splits from a folder; a progress bar shows on a terminal.

    most: views to read of each split, spread evenly; None: all. downscale: how many times its
    images are reduced, those of a large scene in part while they are read; None: as they are
    stored. Raises UserError naming the file, and the key where there is one, for whatever is
    missing, broken or contradictory.
    """
    reader, folder = find_reader(path), Path(path)
    listed = {s: evenly(list_photographs(reader, folder, s), most) for s in splits}
    everything = [photograph for photographs in listed.values() for photograph in photographs]
    _check_alike(folder, everything)
    for photograph in everything if downscale else ():
        check_downscale(photograph.name, photograph.camera, downscale)
    factor = shrink_factor(_sizes(everything), downscale or 1)
    workers, _ = reading(everything, masks)
    images = iter(
        _side_by_side(lambda one: _read_image(folder, one, masks, factor), everything, workers)
    )
    views = {
        split: [_view(one, factor, *next(images)) for one in photographs]
        for split, photographs in listed.items()
    }
    scene = Scene(folder.resolve().name, folder, views)
    return scene.reduced(downscale // factor) if downscale else scene


def reading(photographs: Sequence[Photograph], masks: MaskRule = AS_GIVEN) -> tuple[int, int]:
    """(how many photographs are read side by side, bytes that this takes beside the images that
    stay): as many as there are cores, but no more than READING_BYTES hold.
    """
    most = max(_bytes_of_reading(one, masks) for one in photographs)
    workers = max(1, min(os.cpu_count() or 1, READING_BYTES // most, len(photographs)))
    return workers, workers * most


def _bytes_of_reading(photograph, masks):
    per_pixel = DECODED
    if photograph.distortion:
        per_pixel = UNDISTORTED
    if masks.source == "color" and not masks.folder:
        per_pixel = CUT_OUT
    return per_pixel * photograph.camera.width * photograph.camera.height


def _sizes(photographs):
    return [(one.camera.width, one.camera.height) for one in photographs]


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


def _view(photograph, factor, image, digest):
    camera = photograph.camera
    return View(
        photograph.name,
        camera.downscaled(factor) if factor > 1 else camera,
        image,
        photograph.depth_range,
        digest=digest,
        shrunk=factor,
        unshrunk_camera=camera if factor > 1 else None,
    )


def _check_alike(folder, photographs):
    """Raise UserError if only some photographs have a depth range."""
    first = photographs[0]
    for one in photographs:
        if (one.depth_range is None) != (first.depth_range is None):
            raise UserError(
                f"{folder}: near and far are given for only one of {first.name} and {one.name}; "
                "give them for all views or for none"
            )


def _read_image(folder, photograph, masks, factor):
    """((H, W, 4) uint8 straight RGBA: the image with its mask, freed of distortion and reduced
    `factor` times; the digest of its pixels before that). Raises UserError.
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
    return shrink(image, factor), pixel_digest(image)


def _side_by_side(read: Callable[[Item], Made], items: Sequence[Item], workers: int) -> list[Made]:
    """[read(item)] in order. Raises the UserError of the first that fails."""
    with ThreadPoolExecutor(workers) as pool:
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
