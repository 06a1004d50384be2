"""Loads a scene: images of one object with cameras and masks, from a folder or made by pp-cl."""

import math
import mimetypes
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from pp_cl.engine.device.device import Device
from pp_cl.engine.views import View, border, check_downscale, evenly
from pp_cl.errors import BROKEN_CAMERA, Unusable, UserError, few_names, one_line
from pp_cl.files.image import exif_turns, is_transparent, read_rgba
from pp_cl.progress import track
from pp_cl.scene import demo
from pp_cl.scene.edits import EDITS, Edits, read_edits
from pp_cl.scene.found import (
    IGNORE_FOLDERS,
    MASK_FOLDERS,
    LeftOut,
    find_masks,
    folder_named,
    instead_of_scene,
    pictures_of,
    scene_near,
    usable,
)
from pp_cl.scene.image_file import ImageFile, read_view, shrink, shrink_factor
from pp_cl.scene.lens import BAND_BYTES
from pp_cl.scene.masks import (
    AS_GIVEN,
    OPAQUE,
    fits_turned,
    half_transparent,
    is_by_colour,
    read_mask_of_size,
)
from pp_cl.scene.readers import co3d, colmap, llff, neus, nsvf, transforms
from pp_cl.scene.readers.common import SPLITS
from pp_cl.scene.readings import STATED, read_as
from pp_cl.scene.silhouette import within_silhouettes
from pp_cl.settings import Config, SceneConfig

DEMO = "demo"  # the word that names the scene that pp-cl makes itself

# One module per format. FILES names the files it reads, recognises(folder) tells whether a folder
# holds such files, read_split(folder, split, left_out) lists a split's images as ImageFile without
# reading pixels and adds the views that cannot be used to left_out. STATES is the format's kind of
# matrices, one of readings.MATRICES, and their axes, opengl or opencv. Some modules also have
# splits(folder), the names of the splits, and box(folder), the box that the files state around the
# object. The first module that recognises a folder reads it.
READERS = (transforms, co3d, neus, nsvf, colmap, llff)

# Bytes per pixel that reading takes at its peak, measured with 12 megapixels: to decode an image
# and its mask; to make a mask by colour, of the reduced image, in float64
DECODED, CUT_OUT = 18, 160
BAND_COPIES = 2  # BAND_BYTES for a spline's coefficients, and for the pixels before and after
READING_BYTES = 3 * 2**28  # bytes for the images that are read side by side

LEAST_FOCAL, MOST_FOCAL = 1e-2, 1e7  # pixels; docs/scenes.md has the measurements

MEASURED = 12  # views whose masks are tested for soft edges
# half-transparent share of a mask: 0 at any size if it is sharp, 0.4 if blurred by 5 pixels (sigma)
SOFT = 0.05
INVERTED = 0.95  # share of an image's border that hardly any object's mask covers
BESIDE = 0.5  # share of the transparent pixels that only a mask not of the object covers
WRONG = "the scene's files describe them wrongly"  # for a view whose error is not Unusable
OF_OTHERS = "views without a mask are used inside the hull of the others' masks, except for a rim"
OF_TRAINING = "pictures that are in training, too, so that figures flatter"
FITS = 1.2  # median factor by which masks must fit turned pictures better
TURNED = "pictures are turned as their EXIF says, as only then their masks fit"
STORED = "pictures are taken as they are stored, not turned as their EXIF says"
LEAST_VIEWS = 8  # training views that must remain if others are left out
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")


class SplitFiles(NamedTuple):
    """The images of a split, without their pixels. left_out: names of images that cannot be used,
    with the reason. done: (name of an image, how it was changed to be usable).
    """

    image_files: list[ImageFile]
    left_out: LeftOut
    done: list[tuple[str, str]]


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
        return Scene(DEMO, None, _reduced(rendered, downscale))
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
    _tell(path, lines)
    return scene


def scene_box(config: Config) -> np.ndarray | None:
    """(2, 3) lower and upper corner of the box that the setting scene.box, the user's edits or the
    scene's format state, in this order, or None. Raises UserError for a box without volume.
    """
    corners, path = np.array(config.scene.box, np.float64).reshape(2, 3), config.scene.path
    if not corners.any():
        if path == DEMO:
            return None
        edited, stated = read_edits(Path(path)).box, getattr(find_reader(path), "box", None)
        return stated(Path(path)) if edited is None and stated else edited
    box = np.stack([corners.min(0), corners.max(0)])
    if not (box[1] > box[0]).all():
        raise UserError("scene.box: its corners must differ in x, y and z")
    return box


def scene_format(path: str) -> str:
    """The name of a scene's reader, or "demo" for that scene. Raises UserError."""
    return DEMO if path == DEMO else find_reader(path).__name__.rpartition(".")[2]


def scene_splits(path: Path | str) -> list[str]:
    """The names of a scene's splits. Raises UserError if there is no scene."""
    if path == DEMO:
        return list(demo.SPLITS)
    reader = find_reader(path)
    return reader.splits(Path(path)) if hasattr(reader, "splits") else SPLITS


# Listing a split ----------------------------------------------------------------------------------


def scene_frames(path: str | Path, split: str = "train", *, edited: bool = True) -> list[ImageFile]:
    """The image_files of list_split(), with warnings on images left out or changed."""
    split_files = list_split(path, split, edited=edited)
    _tell(Path(path), _lines(split, *split_files))
    return split_files.image_files


def list_split(path: str | Path, split: str = "train", *, edited: bool = True) -> SplitFiles:
    """The images of a split, without those that the user has dropped if `edited`. Raises UserError
    if too few remain.
    """
    if path == DEMO:
        return SplitFiles(demo.demo_frames(split), [], [])
    folder, reader = Path(path), find_reader(path)
    present = scene_splits(path)
    if split not in present:
        raise UserError(f"{folder}: no split {split}; its splits are {', '.join(present)}")
    left_out: LeftOut = []
    done: list[tuple[str, str]] = []
    edits = read_edits(folder)
    image_files = _right_handed(folder, reader.read_split(folder, split, left_out), left_out, done)
    if edits.axes and edits.axes != STATED:
        image_files = _as_edited(folder, reader, split, image_files, edits)
    if edited:
        image_files = [image for image in image_files if image.name not in edits.dropped]
    if not image_files and not left_out:
        lacks = f"; {EDITS} drops some" if edited and edits.dropped else ""
        raise UserError(f"{folder}: split {split} has no images{lacks}; add some")

    check = partial(with_sound_lens, folder)
    image_files = list(usable(image_files, check, lambda image: image.name, left_out))
    _check_left(image_files, left_out, LEAST_VIEWS if split == "train" else 1)
    image_files, done_to_masks = _masked(folder, reader, image_files, split)
    done += done_to_masks
    image_files = _ignoring(folder, IGNORE_FOLDERS, image_files, split)
    ignored = "pixels are ignored where the masks in ignore are white"
    done += [
        (image.name, ignored) for image in image_files if image.ignore and not image.ignores_black
    ]
    if split != "train" and present is not SPLITS:  # hold_out() never puts a picture in both
        trained: list[ImageFile] = []
        with suppress(UserError):
            trained = reader.read_split(folder, "train", []) if "train" in present else []
        pictures = pictures_of([folder / image.name for image in (*trained, *image_files)])
        known = set(pictures[: len(trained)])
        pairs = zip(image_files, pictures[len(trained) :], strict=True)
        done += [(image.name, OF_TRAINING) for image, picture in pairs if picture in known]
    return SplitFiles(image_files, left_out, done)


def _as_edited(folder: Path, reader: ModuleType, split: str, image_files: list, edits: Edits):
    """The images of a split, with the cameras that all splits have by the `axes` of the edits."""
    others: list[ImageFile] = []
    for other in scene_splits(folder):
        if other != split:
            with suppress(UserError):
                others += _right_handed(folder, reader.read_split(folder, other, []), [], [])
    every = read_as([*image_files, *others], str(edits.axes), reader.STATES, folder)
    return every[: len(image_files)]


def _right_handed(folder, image_files, left_out, done):
    """The images with right-handed poses: mirrored with the world if most poses are left-handed.
    Images whose handedness differs from most go to left_out.
    """
    is_left = [np.linalg.det(image.camera.pose[:, :3]) < 0 for image in image_files]
    are_most, kept = 2 * sum(is_left) >= len(is_left), []
    for image, is_mirrored in zip(image_files, is_left, strict=True):
        if is_mirrored != are_most:
            text = (
                f"{folder / image.name}: its camera's axes have another handedness than the others'"
            )
            left_out.append((image.name, Unusable(f"{text}; write them again", "a mirrored pose")))
        elif not is_mirrored:
            kept.append(image)
        else:
            pose = image.camera.pose * [[-1], [1], [1]]
            kept.append(replace(image, camera=replace(image.camera, pose=pose)))
            what = "poses are left-handed (determinant -1), so they and the world are mirrored"
            done.append((image.name, what))
    return kept


def with_sound_lens(folder: Path, image_file: ImageFile) -> ImageFile:
    """The given image of a folder. Raises Unusable if its camera shows nothing in float32 or its
    distortion folds.
    """
    file, camera = folder / image_file.name, image_file.camera
    for what, values, least in (
        ("focal lengths", (camera.fx, camera.fy), LEAST_FOCAL),
        ("a principal point", (camera.cx, camera.cy), -MOST_FOCAL),
    ):
        if not least <= min(values) <= max(values) <= MOST_FOCAL:
            raise Unusable(
                f"{file}: its camera has {what} of {values[0]:.3g} and {values[1]:.3g} pixels,"
                f" which must be {least:g} to {MOST_FOCAL:g}; correct the scene's file of cameras",
                BROKEN_CAMERA,
            )
    if image_file.lens.folds(camera):
        raise Unusable(
            f"{file}: its distortion coefficients fold the image over; correct them, or undistort"
            " the images with the program that found them",
            "distortion that folds",
        )
    return image_file


def _check_left(kept, left_out, least):
    """Raise the first error of left_out if fewer than `least` images, or less than half, remain."""
    if left_out and len(kept) < max(least, len(left_out)):
        raise left_out[0][1]


def _masked(folder, reader, image_files, split):
    """(The images, with masks from a folder of masks if the format names none; what was done). For
    a transforms.json, the images' own alpha goes before a folder, and if there are other masks of
    the object, the masks that it names mark the usable pixels, as in nerfstudio.
    """
    named, done = [image for image in image_files if image.mask], []
    if named:
        if reader is not transforms or not _are_besides(folder, named[0]):
            return image_files, done
        what = "masks that frames name are taken to mark the usable pixels"
        done = [(image.name, what) for image in named]
        image_files = [
            replace(image, mask=None, ignore=image.mask, ignores_black=True)
            for image in image_files
        ]
    place = folder_named(folder, MASK_FOLDERS)
    for image in image_files if place and reader is transforms else ():
        with suppress(Unusable):  # the first readable image stands for all
            if is_transparent(folder / image.name):
                return image_files, done
            break
    masks = _masks_in(folder, image_files, split, MASK_FOLDERS)
    if masks and reader is transforms:
        what = f"masks are taken from {folder / place}, which no frame names"
        done += [(name, what) for name in masks]
    return [replace(image, mask=masks.get(image.name)) for image in image_files], done


def _masks_in(folder, image_files, split, places):
    """find_masks(), but {} if no image of a split other than train has a mask."""
    try:
        return find_masks(folder, [image.name for image in image_files], places) or {}
    except UserError:
        if split == "train":
            raise
        return {}


def _absolute(folder, masks):
    return {name: str(folder.absolute() / mask) for name, mask in masks.items()}


def _are_besides(folder, image_file):
    """Whether the mask that a frame names is not of the object, judged by the image's alpha or a
    folder of masks.
    """
    place, image = folder_named(folder, MASK_FOLDERS), folder / image_file.name
    if place and not image_file.mask.startswith(f"{place}/"):
        return True
    with suppress(UserError):
        if is_transparent(image):
            outside = read_rgba(image)[..., 3] < OPAQUE // 2
            mask = read_mask_of_size(folder / image_file.mask, outside.shape[::-1])
            return bool(outside.any() and (mask[outside] > OPAQUE // 2).mean() > BESIDE)
    return False


def _ignoring(folder, places, image_files, split):
    """The images, each with its mask of ignored pixels, if the first of the places that exists in a
    folder has one.
    """
    files = _absolute(folder, _masks_in(folder, image_files, split, places))
    return [
        replace(image, ignore=files[image.name], ignores_black=False)
        if image.name in files
        else image
        for image in image_files
    ]


def _lines(split, used, left_out, done):
    """One line for each reason to leave out or change images of a split."""
    names_of: dict[str, list[str]] = {}
    for name, error in left_out:
        names_of.setdefault(f"views left out: {getattr(error, 'why', WRONG)}", []).append(name)
    count, gone = len(used) + len(left_out), len(names_of)
    for name, what in done:
        names_of.setdefault(what, []).append(name)
    return [
        f"{split}: {f'{len(names)} of {count} ' * (i < gone)}{what} ({few_names(names)})"
        for i, (what, names) in enumerate(names_of.items())
    ]


def _tell(folder, lines):
    """Warn once for each line, however often a command asks: Python shows equal warnings from one
    place once.
    """
    for line in lines:
        warnings.warn(one_line(f"{folder}: {line}"), stacklevel=1)


# Finding a scene ----------------------------------------------------------------------------------


def measured_split(path: str) -> str:
    """The split that measures a running training: val, or else test. Raises UserError if there is
    neither.
    """
    present = scene_splits(path)
    if split := next((split for split in ("val", "test") if split in present), ""):
        return split
    raise UserError(f"--eval-every: {path} has no split val or test; leave it out")


def find_reader(path: str | Path) -> ModuleType:
    """The module of READERS for a folder. Raises UserError if the folder holds no scene."""
    folder = Path(path)
    check_folder(folder)
    if os.access(folder, os.R_OK | os.X_OK) and (reader := _reader_of(folder)):
        return reader
    if colmap.model_folder(folder):
        return colmap
    instead = scene_near(folder, _reader_of) or instead_of_scene(folder)
    raise UserError(f"{folder}: no scene in it{instead}")


def check_folder(folder: Path) -> None:
    """Raise UserError if a scene's folder is missing, is not a folder, or cannot be read."""
    if folder.is_file():
        is_video = (mimetypes.guess_type(folder.name)[0] or "").startswith("video/")
        mend = f"a scene is a folder, maybe {folder.absolute().parent}"
        mend = f"`pp-cl capture {folder} --out SCENE` makes a scene from it" if is_video else mend
        mend = "unpack it and give the folder in it" if folder.suffix.lower() in ARCHIVES else mend
        raise UserError(f"{folder}: is a file; {mend}")
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; SCENE is a folder, or the word demo")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be read; check its permissions")


def _reader_of(folder):
    """The reader of a folder, or None if it holds no scene."""
    return next((reader for reader in READERS if reader.recognises(folder)), None)


# Pending images -----------------------------------------------------------------------------------


def load_scene(
    path: str | Path,
    splits: Iterable[str] = ("train",),
    most: int | None = None,
    masks: SceneConfig = AS_GIVEN,
    *,
    dev: Device | None = None,
    downscale: int | None = None,
    listed: Mapping[str, SplitFiles] | None = None,
) -> Scene:
    """The Scene in a folder with the given splits. most: views to read of each split, spread
    evenly; None: all. dev: the device that removes distortion and finds silhouettes for training
    views without masks; without it they are left out. downscale: factor by which images are
    reduced; None: as stored. listed: results of list_split(), by split. Raises UserError naming the
    file and the key for missing, broken or contradictory data, and for distortion without a device.
    """
    folder, lines = Path(path), []
    for option, given in (("--masks", masks.masks), ("--ignore", masks.ignore)):
        if given and not os.path.isdir(given):
            raise UserError(f"{given}: no such folder; {option} takes a folder of masks")
    chosen: dict[str, list[ImageFile]] = {}
    left_out: dict[str, LeftOut] = {}
    for split in splits:
        split_files = (listed or {}).get(split) or list_split(folder, split)
        lines += _lines(split, *split_files)
        chosen[split], left_out[split] = [], []
        chosen_files = _by_rule(masks, evenly(split_files.image_files, most), split)
        chosen_files, done = _as_masks_fit(folder, chosen_files)
        lines += _lines(split, split_files.image_files, [], done)
        for image in chosen_files:
            try:
                if downscale:
                    check_downscale(image.name, image.camera, downscale)
                chosen[split].append(image)
            except UserError as error:
                left_out[split].append((image.name, error))
        _check_left(chosen[split], left_out[split], 1)
    image_files = [image for some in chosen.values() for image in some]
    if dev is None and any(image.lens for image in image_files):
        raise UserError(f"{folder}: its images have distortion, which only a device removes")
    factor = shrink_factor([(p.camera.width, p.camera.height) for p in image_files], downscale or 1)
    views = {
        split: _read_views(folder, some, masks, dev, factor, left_out[split])
        for split, some in chosen.items()
    }
    has_masks = any(v.is_masked or v.has_mask for some in views.values() for v in some)
    for split, gone in left_out.items():
        is_whole, done = split == "train" and most is None, []
        if has_masks:
            views[split], done = _all_masked(folder, views[split], dev if is_whole else None, gone)
        _check_left(views[split], gone, LEAST_VIEWS if is_whole else 1)
        lines += _lines(split, views[split], gone, done)
    _tell(folder, lines)
    views = _reduced(views, downscale // factor) if downscale else views
    return Scene(folder.resolve().name, folder, views, lines)


def _reduced(splits, downscale):
    return {split: [view.reduced(downscale) for view in views] for split, views in splits.items()}


def _by_rule(rule, image_files, split):
    """The images, with masks from the rule's folders, or none if its masks are not files."""
    if rule.masks:
        files = _absolute(Path(rule.masks), _masks_in(Path(rule.masks), image_files, split, ["."]))
        image_files = [replace(image, mask=files.get(image.name)) for image in image_files]
    elif rule.mask_from != "given":
        image_files = [replace(image, mask=None) for image in image_files]
    if rule.ignore:
        image_files = _ignoring(Path(rule.ignore), ["."], image_files, split)
    return image_files


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
    for file in evenly([file for file in asked if file.mask], MEASURED):
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


def _read_views(folder, image_files, masks, dev, factor, left_out):
    """The views of the usable images, several read at a time; the others go to left_out."""

    def read(image_file):
        try:
            return read_view(folder, image_file, masks, dev, factor)
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
    if bare and dev and len(masked) >= max(LEAST_VIEWS, len(bare) + len(left_out)):
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
