"""Scenes: images of one object with cameras and masks, from a folder or made by the program."""

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

DEMO = "demo"  # the word that names the scene which the program makes itself

# One module per format. FILES names the files it reads, recognises(folder) tells whether a folder
# holds such files, read_split(folder, split, left_out) gives a list of ImageFile of one of them
# without reading pixels and adds the views that cannot be used to left_out. STATES is the kind of
# its matrices and of their axes, out of readings.MATRICES and opengl or opencv. Only some have
# splits(folder), the names of its splits, and box(folder), the box that the files state around the
# object. The first that recognises a folder reads it.
READERS = (transforms, co3d, neus, nsvf, colmap, llff)

# Bytes per pixel of what reading takes at its peak, measured with 12 megapixels: decoding and a
# mask; a mask by colour of the reduced image, in float64
DECODED, CUT_OUT = 18, 160
BAND_COPIES = 2  # BAND_BYTES of a spline's coefficients, and the pixels before and after
READING_BYTES = 3 * 2**28  # of the images that are read side by side

LEAST_FOCAL, MOST_FOCAL = 1e-2, 1e7  # pixels; docs/scenes.md says what is measured

MEASURED = 12  # views whose masks are looked at for soft edges
# of what masks hold: sharp ones have 0 at any size, those blurred with a sigma of 5 pixels 0.4
SOFT = 0.05
INVERTED = 0.95  # of the border of an image: hardly any object ends inside and holds so much
BESIDE = 0.5  # of what is transparent, that a mask which is not of the object holds
WRONG = "what the scene's files say of it is wrong"  # of a view whose error is no Unusable
OF_OTHERS = "without a mask, views are used inside the hull of the others' masks, but for a rim"
OF_TRAINING = "pictures that are in training, too, so that figures flatter"
FITS = 1.2  # times better that masks fit pictures which are turned, in the median
TURNED = "pictures are turned as their EXIF says, as their masks fit only so"
STORED = "pictures are taken as they are stored, not turned as their EXIF says"
LEAST_VIEWS = 8  # for training that are left where some are left out
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")


class SplitFiles(NamedTuple):
    """The images of a split, without their pixels. left_out: the names of those that cannot be
    used, and why. done: (name of an image, what was done to use it).
    """

    image_files: list[ImageFile]
    left_out: LeftOut
    done: list[tuple[str, str]]


@dataclass(frozen=True)
class Scene:
    """Views of one object, by split ("train", "val", "test"). folder: None for a scene that the
    program makes itself. notes: lines of what was done to use them, such as views left out.
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
    """Scene of config.scene.path with the given splits, reduced config.scene.downscale times;
    `demo` is rendered on the device. most, listed: as load_scene() takes them.
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
    shares, told = [(border(view.image[..., 3]) > OPAQUE // 2).mean() for view in masked], []
    if masked and np.median(shares) > INVERTED:
        told.append(
            "most masks hold the border of their image, as if they were inverted: they must be"
            " white on the object and black around it"
        )
    alphas = [shrink(view.image, view.downscale)[..., 3] for view in evenly(masked, MEASURED)]
    if masked and (soft := np.mean([half_transparent(alpha) for alpha in alphas])) > SOFT:
        told.append(
            f"{soft:.0%} of what the masks hold is half transparent, edges not counted: where the"
            " object is opaque, sharp masks give a sharper model"
        )
    if views and not masked and most is None and config.scene.mask_from != "box":
        told.append(
            "no image has a mask: points fill the box that all cameras see; --mask-from color cuts"
            " out a uniform background, --masks FOLDER takes masks, --mask-from box says that it is"
            " meant"
        )
    _tell(path, told)
    return scene


def scene_box(config: Config) -> np.ndarray | None:
    """(2, 3) lower and upper corner of the setting scene.box, else of the user's edits, else
    of what the scene's format states, or None. Raises UserError for a box without volume.
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
    """The name of the reader of a scene; of `demo` the word itself. Raises UserError."""
    return DEMO if path == DEMO else find_reader(path).__name__.rpartition(".")[2]


def scene_splits(path: Path | str) -> list[str]:
    """The names of a scene's splits. Raises UserError where there is no scene."""
    if path == DEMO:
        return list(demo.SPLITS)
    reader = find_reader(path)
    return reader.splits(Path(path)) if hasattr(reader, "splits") else SPLITS


# Listing a split ----------------------------------------------------------------------------------


def scene_frames(path: str | Path, split: str = "train", *, edited: bool = True) -> list[ImageFile]:
    """list_split()'s image_files; what it left out and did becomes warnings."""
    found = list_split(path, split, edited=edited)
    _tell(Path(path), _lines(split, *found))
    return found.image_files


def list_split(path: str | Path, split: str = "train", *, edited: bool = True) -> SplitFiles:
    """The images of a split; edited: but for those that the user has dropped. Raises UserError
    where too few are left.
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
        image_files = [one for one in image_files if one.name not in edits.dropped]
    if not image_files and not left_out:
        lacks = f"; {EDITS} drops some" if edited and edits.dropped else ""
        raise UserError(f"{folder}: split {split} has no images{lacks}; add some")

    check = partial(with_sound_lens, folder)
    image_files = list(usable(image_files, check, lambda one: one.name, left_out))
    _check_left(image_files, left_out, LEAST_VIEWS if split == "train" else 1)
    image_files, told = _masked(folder, reader, image_files, split)
    done += told
    image_files = _ignoring(folder, IGNORE_FOLDERS, image_files, split)
    ignored = "pixels are ignored where the masks in ignore are white"
    done += [(one.name, ignored) for one in image_files if one.ignore and not one.ignores_black]
    if split != "train" and present is not SPLITS:  # else hold_out() has dealt out pictures
        trained: list[ImageFile] = []
        with suppress(UserError):
            trained = reader.read_split(folder, "train", []) if "train" in present else []
        pictures = pictures_of([folder / one.name for one in (*trained, *image_files)])
        known = set(pictures[: len(trained)])
        found = zip(image_files, pictures[len(trained) :], strict=True)
        done += [(one.name, OF_TRAINING) for one, picture in found if picture in known]
    return SplitFiles(image_files, left_out, done)


def _as_edited(folder: Path, reader: ModuleType, split: str, image_files: list, edits: Edits):
    """The images of a split with cameras as `axes` of the edits has them, of all splits."""
    others: list[ImageFile] = []
    for other in scene_splits(folder):
        if other != split:
            with suppress(UserError):
                others += _right_handed(folder, reader.read_split(folder, other, []), [], [])
    every = read_as([*image_files, *others], str(edits.axes), reader.STATES, folder)
    return every[: len(image_files)]


def _right_handed(folder, image_files, left_out, done):
    """The images; where most poses are left-handed, those in the world's mirror image."""
    is_left = [np.linalg.det(one.camera.pose[:, :3]) < 0 for one in image_files]
    are_most, kept = 2 * sum(is_left) >= len(is_left), []
    for one, left in zip(image_files, is_left, strict=True):
        if left != are_most:
            text = (
                f"{folder / one.name}: its camera's axes have another handedness than the others'"
            )
            left_out.append((one.name, Unusable(f"{text}; write them again", "a mirrored pose")))
        elif not left:
            kept.append(one)
        else:
            pose = one.camera.pose * [[-1], [1], [1]]
            kept.append(replace(one, camera=replace(one.camera, pose=pose)))
            what = "poses are left-handed (determinant -1), and read in the world's mirror image"
            done.append((one.name, what))
    return kept


def with_sound_lens(folder: Path, image_file: ImageFile) -> ImageFile:
    """The same image of a folder. Raises Unusable where its camera shows nothing in float32, or its
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


def _check_left(left, left_out, least):
    """Raise the first error of left_out where fewer than `least`, or less than half, are left."""
    if left_out and len(left) < max(least, len(left_out)):
        raise left_out[0][1]


def _masked(folder, reader, image_files, split):
    """(The images, with the masks of a folder of masks where the format names none; what was
    done). Images of a transforms.json have their own alpha, if any, and where masks are of the
    object, masks that it names say where images are of use, as nerfstudio takes it.
    """
    named, done = [one for one in image_files if one.mask], []
    if named:
        if reader is not transforms or not _are_besides(folder, named[0]):
            return image_files, done
        what = "masks that frames name are taken for where images are of use"
        done = [(one.name, what) for one in named]
        image_files = [
            replace(one, mask=None, ignore=one.mask, ignores_black=True) for one in image_files
        ]
    place = folder_named(folder, MASK_FOLDERS)
    for one in image_files if place and reader is transforms else ():
        with suppress(Unusable):  # the first image that can be read tells of all
            if is_transparent(folder / one.name):
                return image_files, done
            break
    masks = _masks_in(folder, image_files, split, MASK_FOLDERS)
    if masks and reader is transforms:
        what = f"masks are taken from {folder / place}, which no frame names"
        done += [(name, what) for name in masks]
    return [replace(one, mask=masks.get(one.name)) for one in image_files], done


def _masks_in(folder, image_files, split, places):
    """find_masks(); {} for other splits than train where no image has one."""
    try:
        return find_masks(folder, [one.name for one in image_files], places) or {}
    except UserError:
        if split == "train":
            raise
        return {}


def _absolute(folder, masks):
    return {name: str(folder.absolute() / mask) for name, mask in masks.items()}


def _are_besides(folder, image_file):
    """Whether the mask that a frame names is none of the object, by alpha or a folder of masks."""
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
    """The images, with the masks of what says nothing in one of the places in a folder."""
    files = _absolute(folder, _masks_in(folder, image_files, split, places))
    return [
        replace(one, ignore=files[one.name], ignores_black=False) if one.name in files else one
        for one in image_files
    ]


def _lines(split, used, left_out, done):
    """One line for each kind of thing that was left out or done in a split."""
    told: dict[str, list[str]] = {}
    for name, error in left_out:
        told.setdefault(f"views left out: {getattr(error, 'why', WRONG)}", []).append(name)
    count, gone = len(used) + len(left_out), len(told)
    for name, what in done:
        told.setdefault(what, []).append(name)
    return [
        f"{split}: {f'{len(names)} of {count} ' * (i < gone)}{what} ({few_names(names)})"
        for i, (what, names) in enumerate(told.items())
    ]


def _tell(folder, lines):
    """Warn of each line once, however often a command asks: equal warnings of one line are one."""
    for line in lines:
        warnings.warn(one_line(f"{folder}: {line}"), stacklevel=1)


# Finding a scene ----------------------------------------------------------------------------------


def measured_split(path: str) -> str:
    """The split that tells how a training goes: val, else test. Raises UserError without either."""
    present = scene_splits(path)
    if split := next((split for split in ("val", "test") if split in present), ""):
        return split
    raise UserError(f"--eval-every: {path} has no split val or test; leave it out")


def find_reader(path: str | Path) -> ModuleType:
    """The module of READERS for a folder. Raises UserError where it holds no scene."""
    folder = Path(path)
    check_folder(folder)
    if os.access(folder, os.R_OK | os.X_OK) and (reader := _reader_of(folder)):
        return reader
    if colmap.model_folder(folder):
        return colmap
    instead = scene_near(folder, _reader_of) or instead_of_scene(folder)
    raise UserError(f"{folder}: no scene in it{instead}")


def check_folder(folder: Path) -> None:
    """Raise UserError where a scene's folder is missing, no folder, or cannot be read."""
    if folder.is_file():
        is_video = (mimetypes.guess_type(folder.name)[0] or "").startswith("video/")
        mend = f"a scene is a folder, maybe {folder.absolute().parent}"
        mend = f"`pp-cl capture {folder} --out SCENE` makes a scene of it" if is_video else mend
        mend = "unpack it and give the folder in it" if folder.suffix.lower() in ARCHIVES else mend
        raise UserError(f"{folder}: is a file; {mend}")
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; SCENE is a folder, or the word demo")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be read; check its permissions")


def _reader_of(folder):
    """The reader of a folder, None where it holds no scene."""
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
    """Scene of the given splits from a folder. most: views to read of each
    split, spread evenly; None: all. dev: removes distortion, and finds silhouettes for training
    views without masks, which are left out without it. downscale: how many times images are
    reduced; None: as they are stored. listed: what list_split() gave of some splits. Raises
    UserError naming the file, and the key, for whatever is missing, broken or contradictory, and
    for distortion without a device.
    """
    folder, lines = Path(path), []
    for option, given in (("--masks", masks.masks), ("--ignore", masks.ignore)):
        if given and not os.path.isdir(given):
            raise UserError(f"{given}: no such folder; {option} takes one of masks")
    chosen: dict[str, list[ImageFile]] = {}
    left_out: dict[str, LeftOut] = {}
    for split in splits:
        found = (listed or {}).get(split) or list_split(folder, split)
        lines += _lines(split, *found)
        chosen[split], left_out[split] = [], []
        chosen_files = _by_rule(masks, evenly(found.image_files, most), split)
        chosen_files, done = _as_masks_fit(folder, chosen_files)
        lines += _lines(split, found.image_files, [], done)
        for one in chosen_files:
            try:
                if downscale:
                    check_downscale(one.name, one.camera, downscale)
                chosen[split].append(one)
            except UserError as error:
                left_out[split].append((one.name, error))
        _check_left(chosen[split], left_out[split], 1)
    image_files = [one for some in chosen.values() for one in some]
    if dev is None and any(one.lens for one in image_files):
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
    """The images, with the masks of the rule's folders, and none where its masks are no files."""
    if rule.masks:
        files = _absolute(Path(rule.masks), _masks_in(Path(rule.masks), image_files, split, ["."]))
        image_files = [replace(one, mask=files.get(one.name)) for one in image_files]
    elif rule.mask_from != "given":
        image_files = [replace(one, mask=None) for one in image_files]
    if rule.ignore:
        image_files = _ignoring(Path(rule.ignore), ["."], image_files, split)
    return image_files


def _as_masks_fit(folder, image_files):
    """(The images, what was done): pictures whose EXIF turns them though their size does not ask
    for it are turned where their masks fit only so.
    """
    asked = []
    for one in image_files:
        with suppress(Unusable):  # what cannot be read is left out later
            turns, is_square = exif_turns(folder / one.name), one.camera.width == one.camera.height
            asked += [one] if turns == 2 or (turns and is_square) else []
    fits = []
    for one in evenly([one for one in asked if one.mask], MEASURED):
        with suppress(UserError):
            image, turned = (
                read_rgba(folder / one.name, turned=is_turned) for is_turned in (False, True)
            )
            mask = read_mask_of_size(folder / str(one.mask), image.shape[1::-1])
            fits.append(fits_turned(image, turned, mask))
    is_turned = bool(fits) and np.median(fits) > FITS
    turned = {one.name for one in asked if one.mask and is_turned}
    image_files = [replace(one, turned=one.name in turned) for one in image_files]
    return image_files, [(one.name, TURNED if one.name in turned else STORED) for one in asked]


def _read_views(folder, image_files, masks, dev, factor, left_out):
    """The views of the images that can be used, several read at a time."""

    def read(image_file):
        try:
            return read_view(folder, image_file, masks, dev, factor)
        except UserError as error:
            return error

    views = []
    with ThreadPoolExecutor(reading_cost(image_files, masks, factor)[0]) as pool:
        reads = track(pool.map(read, image_files), "reading images", "image", len(image_files))
        for image_file, found in zip(image_files, reads, strict=True):
            if isinstance(found, UserError):
                left_out.append((image_file.name, found))
            else:
                views.append(found)
    return views


def _all_masked(folder, views, dev, left_out):
    """(views that all have masks, what was done): those without are used inside the hull of the
    others' masks, on a device, and left out else.
    """
    bare = [view for view in views if not (view.is_masked or view.has_mask)]
    masked = [view for view in views if view.is_masked or view.has_mask]
    if bare and dev and len(masked) >= max(LEAST_VIEWS, len(bare) + len(left_out)):
        with suppress(UserError):
            filled = {view.name: view for view in within_silhouettes(dev, masked, bare)}
            views = [filled.get(view.name, view) for view in views]
            return views, [(name, OF_OTHERS) for name in filled]
    for view in bare:
        text = f"{folder / view.name}: has no mask, as others have; add it, or remove all"
        left_out.append((view.name, Unusable(text, "no mask")))
    return masked, []


def reading_cost(
    image_files: Sequence[ImageFile], masks: SceneConfig = AS_GIVEN, factor: int = 1
) -> tuple[int, int]:
    """(how many images are read side by side, bytes that this takes beside the images that stay):
    as many as there are cores and READING_BYTES hold.
    """
    per_pixel = DECODED + (CUT_OUT / factor**2 if is_by_colour(masks) else 0)
    pixels = max(one.camera.width * one.camera.height for one in image_files)
    most = math.ceil(per_pixel * pixels)
    workers = max(1, min(os.cpu_count() or 1, READING_BYTES // most, len(image_files)))
    is_bent = any(one.lens for one in image_files)
    return workers, workers * most + (BAND_COPIES * BAND_BYTES if is_bent else 0)
