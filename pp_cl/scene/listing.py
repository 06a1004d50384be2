"""Lists a scene's images without their pixels: what its reader finds, the user's edits, and folders
of masks.
"""

import mimetypes
import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from pp_cl.errors import BROKEN_CAMERA, Unusable, UserError, few_names, one_line, pasted
from pp_cl.files.image import is_transparent, read_rgba
from pp_cl.scene import demo
from pp_cl.scene.conventions import STATED, read_as
from pp_cl.scene.edits import EDITS, Edits, read_edits
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import (
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
from pp_cl.scene.masks import OPAQUE, read_mask_of_size
from pp_cl.scene.readers import co3d, colmap, llff, neus, nsvf, transforms
from pp_cl.scene.readers.common import SPLITS
from pp_cl.settings import Config, SceneConfig

DEMO = "demo"  # the word that names the scene that pp-cl makes itself

# One module per format. FILES names the files it reads, recognises(folder) tells whether a folder
# holds such files, read_split(folder, split, left_out) lists a split's images as ImageFile without
# reading pixels and adds the views that cannot be used to left_out. STATES is the format's kind of
# matrices, one of conventions.MATRICES, and their axes, opengl or opencv. Some modules also have
# splits(folder), the names of the splits, and box(folder), the box that the files state around the
# object. The first module that recognises a folder reads it.
READERS = (transforms, co3d, neus, nsvf, colmap, llff)

LEAST_FOCAL, MOST_FOCAL = 1e-2, 1e7  # pixels; docs/scenes.md has the measurements

BESIDE = 0.5  # share of the transparent pixels that only a mask not of the object covers
WRONG = "the scene's files describe them wrongly"  # for a view whose error is not Unusable
OF_TRAINING = "pictures that are in training, too, so that figures flatter"
LEAST_VIEWS = 8  # training views that must remain if others are left out
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")


class SplitFiles(NamedTuple):
    """The images of a split, without their pixels. left_out: names of images that cannot be used,
    with the reason. done: (name of an image, how it was changed to be usable).
    """

    image_files: list[ImageFile]
    left_out: LeftOut
    done: list[tuple[str, str]]


# The scene in a folder ----------------------------------------------------------------------------


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
        capture = f"`pp-cl capture {pasted(folder)} --out SCENE` makes a scene from it"
        mend = capture if is_video else mend
        mend = "unpack it and give the folder in it" if folder.suffix.lower() in ARCHIVES else mend
        raise UserError(f"{folder}: is a file; {mend}")
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; SCENE is a folder, or the word demo")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be read; check its permissions")


def _reader_of(folder):
    """The reader of a folder, or None if it holds no scene."""
    return next((reader for reader in READERS if reader.recognises(folder)), None)


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


def measured_split(path: str) -> str:
    """The split that measures a running training: val, or else test. Raises UserError if there is
    neither.
    """
    present = scene_splits(path)
    if split := next((split for split in ("val", "test") if split in present), ""):
        return split
    raise UserError(f"--eval-every: {path} has no split val or test; leave it out")


# A split -----------------------------------------------------------------------------------------


def scene_frames(path: str | Path, split: str = "train", *, edited: bool = True) -> list[ImageFile]:
    """The image_files of list_split(), with warnings on images left out or changed."""
    split_files = list_split(path, split, edited=edited)
    tell(Path(path), split_lines(split, *split_files))
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
    check_left(image_files, left_out, LEAST_VIEWS if split == "train" else 1)
    image_files, done_to_masks = _masked(folder, reader, image_files, split)
    done += done_to_masks
    image_files = _ignoring(folder, IGNORE_FOLDERS, image_files, split)
    ignored = "pixels are ignored where the masks in ignore are white"
    done += [
        (image.name, ignored) for image in image_files if image.ignore and not image.ignores_black
    ]
    if split != "train" and hasattr(reader, "splits"):  # hold_out() puts no picture in both
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
    are_most, kept = 2 * sum(is_left) > len(is_left), []
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


def check_left(kept: Sequence[Any], left_out: LeftOut, least: int) -> None:
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


def with_masks(rule: SceneConfig, image_files: list[ImageFile], split: str) -> list[ImageFile]:
    """The images, with masks from the rule's folders, or none if its masks are not files."""
    if rule.masks:
        files = _absolute(Path(rule.masks), _masks_in(Path(rule.masks), image_files, split, ["."]))
        image_files = [replace(image, mask=files.get(image.name)) for image in image_files]
    elif rule.mask_from != "given":
        image_files = [replace(image, mask=None) for image in image_files]
    if rule.ignore:
        image_files = _ignoring(Path(rule.ignore), ["."], image_files, split)
    return image_files


def split_lines(
    split: str, used: Sequence[Any], left_out: LeftOut, done: list[tuple[str, str]]
) -> list[str]:
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


def tell(folder: Path | str, lines: Iterable[str]) -> None:
    """Warn once for each line, however often a command asks: Python shows equal warnings from one
    place once.
    """
    for line in lines:
        warnings.warn(one_line(f"{folder}: {line}"), stacklevel=1)
