"""Loads a scene: images of one object with cameras and masks, from a folder or made by pp-cl."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pp_cl.engine.camera import divided
from pp_cl.engine.device.device import Device
from pp_cl.engine.views import View, border, check_downscale, evenly
from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import exif_turns, read_rgba
from pp_cl.progress import track
from pp_cl.scene import demo
from pp_cl.scene.image_file import ImageFile, read_view, shrink, shrink_factor
from pp_cl.scene.lens import BAND_BYTES
from pp_cl.scene.listing import (
    DEMO,
    LEAST_VIEWS,
    SplitFiles,
    check_left,
    list_split,
    split_lines,
    tell,
    with_masks,
)
from pp_cl.scene.lookup import LeftOut
from pp_cl.scene.masks import (
    AS_GIVEN,
    OPAQUE,
    fits_turned,
    half_transparent,
    is_by_colour,
    read_mask_of_size,
)
from pp_cl.scene.silhouette import within_silhouettes
from pp_cl.settings import Config, SceneConfig

# Bytes per pixel that reading takes at its peak, measured with 12 megapixels: to decode an image
# and its mask; to make a mask by colour, of the reduced image, in float64
DECODED, CUT_OUT = 18, 160
BAND_COPIES = 2  # BAND_BYTES for a spline's coefficients, and for the pixels before and after
READING_BYTES = 3 * 2**28  # bytes for the images that are read side by side

MEASURED = 12  # views whose masks are tested for soft edges
# half-transparent share of a mask: 0 at any size if it is sharp, 0.4 if blurred by 5 pixels (sigma)
SOFT = 0.05
INVERTED = 0.95  # share of an image's border that hardly any object's mask covers
LEAST_MASKED = 0.25  # share of the views whose masks give the others one
OF_OTHERS = "views without a mask are used inside the hull of the others' masks, except for a rim"
FITS = 1.2  # median factor by which masks must fit turned pictures better
TURNED = "pictures are turned as their EXIF says, as only then their masks fit"
STORED = "pictures are taken as they are stored, not turned as their EXIF says"


@dataclass(frozen=True)
class Scene:
    """Views of one object, by split ("train", "val", "test"). folder: None for the scene that pp-cl
    makes itself. notes: one line per warning, such as on views left out.
    """

    name: str
    folder: Path | None
    splits: dict[str, list[View]]
    notes: Sequence[str] = ()


def open_scene(
    dev: Device,
    config: Config,
    splits: tuple[str, ...],
    most: int | None = None,
    listed: Mapping[str, SplitFiles] | None = None,
) -> Scene:
    """The Scene at config.scene.path with the given splits, reduced config.scene.downscale times;
    `demo` is rendered on the device. most, listed: as in load_scene().
    """
    path, downscale = config.scene.path, config.scene.downscale
    if path == DEMO:
        rendered = {split: demo.demo_views(dev, split, most) for split in splits}
        whole, ratio = divided(downscale)
        fitted = {s: [_resampled(view, ratio) for view in views] for s, views in rendered.items()}
        return Scene(DEMO, None, _reduced(fitted, whole))
    scene = load_scene(
        path, splits, most, config.scene, downscale=downscale, listed=listed, dev=dev
    )
    views = scene.splits.get("train", [])
    masked = [view for view in views if view.has_mask]
    shares, lines = [(border(view.image[..., 3]) > OPAQUE // 2).mean() for view in masked], []
    if masked and np.median(shares) > INVERTED:
        lines.append(
            "most masks cover the border of their image, as if they were inverted: they must be"
            " white on the object and black around it"
        )
    alphas = [shrink(view.image, view.downscale)[..., 3] for view in evenly(masked, MEASURED)]
    if masked and (soft := np.mean([half_transparent(alpha) for alpha in alphas])) > SOFT:
        lines.append(
            f"{soft:.0%} of the masks' area is half transparent, not counting edges: if the object"
            " is opaque, sharp masks give a sharper model"
        )
    if views and not masked and most is None and config.scene.mask_from != "box":
        lines.append(
            "no image has a mask: points fill the box that all cameras see; --mask-from color cuts"
            " out a uniform background, --masks FOLDER takes masks, --mask-from box confirms that"
            " the box is intended"
        )
    tell(path, lines)
    return scene


def load_scene(
    path: str | Path,
    splits: Iterable[str] = ("train",),
    most: int | None = None,
    masks: SceneConfig = AS_GIVEN,
    *,
    dev: Device | None = None,
    downscale: float | None = None,
    listed: Mapping[str, SplitFiles] | None = None,
) -> Scene:
    """The Scene in a folder with the given splits. most: views to read of each split, spread
    evenly; None: all. dev: the device that removes distortion and finds silhouettes for training
    views without masks; without it they are left out. downscale: factor by which images are
    reduced; None: as stored. listed: results of list_split(), by split. Raises UserError naming the
    file and the key for missing, broken or contradictory data, and for distortion without a device.
    """
    folder, lines = Path(path), []
    for option, mask_folder in (("--masks", masks.masks), ("--ignore", masks.ignore)):
        if mask_folder and not os.path.isdir(mask_folder):
            raise UserError(f"{mask_folder}: no such folder; {option} takes a folder of masks")
    chosen: dict[str, list[ImageFile]] = {}
    left_out: dict[str, LeftOut] = {}
    for split in splits:
        split_files = (listed or {}).get(split) or list_split(folder, split)
        lines += split_lines(split, *split_files)
        chosen[split], left_out[split] = [], []
        chosen_files = with_masks(masks, evenly(split_files.image_files, most), split)
        chosen_files, done = _as_masks_fit(folder, chosen_files)
        lines += split_lines(split, split_files.image_files, [], done)
        for image in chosen_files:
            try:
                if downscale:
                    check_downscale(image.name, image.camera, downscale)
                chosen[split].append(image)
            except UserError as error:
                left_out[split].append((image.name, error))
        check_left(chosen[split], left_out[split], 1)
    image_files = [image for files in chosen.values() for image in files]
    if dev is None and any(image.lens for image in image_files):
        raise UserError(f"{folder}: its images have distortion, which only a device removes")
    whole, ratio = divided(downscale or 1)
    factor = shrink_factor([(p.camera.width, p.camera.height) for p in image_files], whole)
    views = {
        split: _read_views(folder, files, masks, dev, (factor, ratio), left_out[split])
        for split, files in chosen.items()
    }
    has_masks = any(v.is_masked or v.has_mask for of_split in views.values() for v in of_split)
    for split, gone in left_out.items():
        is_whole, done = split == "train" and most is None, []
        if has_masks:
            views[split], done = _all_masked(folder, views[split], dev if is_whole else None, gone)
        check_left(views[split], gone, LEAST_VIEWS if is_whole else 1)
        lines += split_lines(split, views[split], gone, done)
    tell(folder, lines)
    views = _reduced(views, whole // factor) if downscale else views
    return Scene(folder.resolve().name, folder, views, lines)


def _reduced(splits, downscale):
    return {split: [view.reduced(downscale) for view in views] for split, views in splits.items()}


def _resampled(view, ratio):
    """The view with an image of fewer pixels, by a ratio."""
    width, height = view.stored_camera.width, view.stored_camera.height
    return view.resampled(int(width / ratio), int(height / ratio)) if ratio > 1 else view


def _as_masks_fit(folder, image_files):
    """(The images, what was done): pictures that fit their camera with and without the EXIF
    orientation are turned if only then their masks fit.
    """
    asked = []
    for file in image_files:
        with suppress(Unusable):  # an unreadable image is left out later
            turns = exif_turns(folder / file.name)
            is_square = file.camera.width == file.camera.height
            asked += [file] if turns == 2 or (turns and is_square) else []
    fits = []
    masked = [file for file in asked if file.mask]
    for file in evenly(masked, MEASURED):
        if min(file.camera.width, file.camera.height) < 2:
            continue  # has no gradient
        with suppress(UserError):
            image, turned = (
                read_rgba(folder / file.name, turned=is_turned) for is_turned in (False, True)
            )
            mask = read_mask_of_size(folder / str(file.mask), image.shape[1::-1])
            fits.append(fits_turned(image, turned, mask))
    is_turned = bool(fits) and np.median(fits) > FITS
    turned = {file.name for file in asked if file.mask and is_turned}
    image_files = [replace(file, turned=file.name in turned) for file in image_files]
    return image_files, [(file.name, TURNED if file.name in turned else STORED) for file in asked]


def _read_views(folder, image_files, masks, dev, factors, left_out):
    """The views of the usable images, several read at a time, reduced a whole number of times and
    then resampled by a ratio; the others go to left_out.
    """
    factor, ratio = factors

    def read(image_file):
        try:
            return _resampled(read_view(folder, image_file, masks, dev, factor), ratio)
        except UserError as error:
            return error

    views = []
    with ThreadPoolExecutor(reading_cost(image_files, masks, factor)[0]) as pool:
        reads = track(pool.map(read, image_files), "reading images", "image", len(image_files))
        for image_file, result in zip(image_files, reads, strict=True):
            if isinstance(result, UserError):
                left_out.append((image_file.name, result))
            else:
                views.append(result)
    return views


def _all_masked(folder, views, dev, left_out):
    """(views that all have masks, what was done). Views without a mask get the silhouette of the
    others' hull, if there is a device and there are enough masks; otherwise they are left out.
    """
    bare = [view for view in views if not (view.is_masked or view.has_mask)]
    masked = [view for view in views if view.is_masked or view.has_mask]
    if bare and dev and len(masked) >= max(LEAST_VIEWS, LEAST_MASKED * len(views)):
        with suppress(UserError):
            filled = {view.name: view for view in within_silhouettes(dev, masked, bare)}
            views = [filled.get(view.name, view) for view in views]
            return views, [(name, OF_OTHERS) for name in filled]
    for view in bare:
        text = f"{folder / view.name}: has no mask, but others have; add it, or remove all"
        left_out.append((view.name, Unusable(text, "no mask")))
    return masked, []


def reading_cost(
    image_files: Sequence[ImageFile], masks: SceneConfig = AS_GIVEN, factor: int = 1
) -> tuple[int, int]:
    """(number of images to read side by side, bytes that this takes besides the images themselves):
    as many images as there are cores and as READING_BYTES hold.
    """
    per_pixel = DECODED + (CUT_OUT / factor**2 if is_by_colour(masks) else 0)
    pixels = max(image.camera.width * image.camera.height for image in image_files)
    most = math.ceil(per_pixel * pixels)
    workers = max(1, min(os.cpu_count() or 1, READING_BYTES // most, len(image_files)))
    is_bent = any(image.lens for image in image_files)
    return workers, workers * most + (BAND_COPIES * BAND_BYTES if is_bent else 0)
