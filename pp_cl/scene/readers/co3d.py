"""Reader of single sequences of CO3D, versions 1 and 2: CATEGORY/SEQUENCE/ with images and masks,
whose annotations lie in CATEGORY/, outside the scene's folder.
"""

import gzip
import json
import os
import re
import zlib
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.errors import Unusable, UserError, quoted
from pp_cl.files.image import image_size
from pp_cl.files.untrusted import opened_regular, refusal
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import LeftOut, find_image, usable
from pp_cl.scene.readers.common import MOST, SPLITS, hold_out, progress, read_json
from pp_cl.scene.readers.frame import Frame, rigid

FILES = "a sequence of CO3D, whose frame_annotations.jgz lies one folder above"
STATES = "world-to-camera", "opencv"
ANNOTATIONS = "frame_annotations.jgz"
# characters of a file of annotations, and frames in it: the largest category has less than half
MOST_TEXT, MOST_FRAMES = 2**30, 2**20
MOST_SUM = 2**22  # characters of the frames of one sequence, enough for 3,500 frames
BETWEEN = re.compile(r"[\s,\[]*")  # characters between the objects of a list
PIECE = 2**18  # characters that are unpacked at once; a frame takes some 1,200
# PyTorch3D: x left, y up, z forwards; OpenCV: x right, y down, z forwards
CV_FROM_P3D = np.diag([-1.0, -1.0, 1.0])
# units of focal lengths and principal points: half the width and height, or the smaller of both
NORMALISED, ISOTROPIC = "ndc_norm_image_bounds", "ndc_isotropic"


def recognises(folder: Path) -> bool:
    """Whether the folder has images and its parent has annotations."""
    folder = _whole(folder)
    return (folder / "images").is_dir() and (folder.parent / ANNOTATIONS).is_file()


def splits(folder: Path) -> list[str]:
    """Train and test, and val if a set list has frames for it."""
    listed = _set_list(_whole(folder))
    return sorted(listed) if listed else SPLITS


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[ImageFile]:
    """The images that _set_list() has for a split, in the order of their frame numbers; without a
    list, every eighth is for test. Frames with an empty mask are left out. Raises UserError.
    """
    folder = _whole(folder)
    file, listed = folder.parent / ANNOTATIONS, _set_list(folder)
    frames = [
        Frame(file, {}, own, index)
        for index, own in _annotations(file, folder.name, file.stat().st_mtime_ns)
    ]
    if not frames:
        raise UserError(f"{file}: has no frame of sequence {folder.name}; give another folder")
    for frame in frames:
        if frame.number("frame_number") is None:
            raise frame.error("frame_number", "is missing; copy the annotations again")
    chosen = [frame for frame in frames if not _is_empty(frame)]
    chosen.sort(key=lambda frame: frame.get("frame_number"))
    if listed is None:
        chosen = hold_out(chosen, split)
    else:
        chosen = [frame for frame in chosen if _path(frame, "image") in listed[split]]
    read = partial(_image_file, folder)
    return list(usable(progress(chosen), read, lambda frame: f"frame {frame.index}", left_out))


def _whole(folder):
    """The folder's absolute path. Links stay unresolved: the annotations lie next to the link."""
    return Path(os.path.abspath(folder))


@lru_cache(maxsize=1)
def _annotations(file, sequence, _changed):
    """[(index, annotation)] of a sequence's frames in a file. _changed: the file's time of change,
    so that the cache is not stale.
    """
    annotations, characters_left = [], MOST_SUM
    try:
        with opened_regular(file) as packed, gzip.open(packed, "rt", encoding="utf-8") as opened:
            for index, (own, size) in enumerate(_objects(opened)):
                if own.get("sequence_name") == sequence:
                    annotations.append((index, own))
                    characters_left -= size
                if characters_left < 0 or index == MOST_FRAMES:
                    raise ValueError(
                        f"more than {MOST_FRAMES} frames, or {MOST_SUM} characters of one sequence"
                    )
    except (OSError, EOFError, zlib.error, ValueError, RecursionError) as error:
        raise refusal(file, error, "gzipped JSON") from None
    return annotations


def _objects(opened):
    """Yield (object, its number of characters) from a JSON list of objects in a text file. Raises
    ValueError.
    """
    decode, text, at = json.JSONDecoder().raw_decode, opened.read(PIECE), 0
    characters_left = MOST_TEXT - len(text)
    if not text.lstrip().startswith("["):
        raise ValueError("is no list of annotations")
    while True:
        piece = opened.read(PIECE) if len(text) - at < PIECE else ""
        characters_left -= len(piece)
        if characters_left < 0:
            raise ValueError(f"more than {MOST_TEXT} characters")
        if piece:
            text, at = text[at:] + piece, 0
        at = BETWEEN.match(text, at).end()
        if text.startswith("]", at):
            return
        if at < len(text):
            own, end = decode(text, at)
            if not isinstance(own, dict):
                raise ValueError("is no list of annotations")
            yield own, end - at
            at = end
        elif not piece:
            raise ValueError("ends too early")


def _is_empty(frame):
    """Whether a frame's annotation says that its mask has no pixel."""
    mask = frame.get("mask")
    if not isinstance(mask, dict):
        return False
    return Frame(frame.file, {}, mask, frame.index, "mask of frame ").number("mass", above=-1) == 0


def _path(frame, key):
    """The path of an image or mask in the dataset."""
    value = frame.get(key)
    path = value.get("path") if isinstance(value, dict) else None
    if not isinstance(path, str) or not path:
        raise frame.error(key, "must have the path of an image")
    return path


def _image_file(folder, frame):
    name = _found(folder, frame, "image")
    mask = _found(folder, frame, "mask") if frame.get("mask") is not None else None
    size = image_size(folder / name)
    stated = frame.get("image").get("size")
    if stated not in (None, [size[1], size[0]]):
        there = f"but {name} has {size[0]}x{size[1]}; copy it again"
        raise frame.error("image", f"has the size {quoted(stated, 40)} (height, width), {there}")
    return ImageFile(name, _camera(frame, size), mask=mask)


def _found(folder, frame, key):
    """Path of an image or mask, relative to the sequence's folder."""
    path, fail = PurePosixPath(_path(frame, key)), partial(frame.error, key)
    if path.parts[:2] != (folder.parent.name, folder.name):
        raise fail(f"{str(path)!r} is not in {folder.parent.name}/{folder.name}; move it there")
    return find_image(folder, PurePosixPath(*path.parts[2:]).as_posix(), fail, kind=key)


def _camera(frame, size):
    """The Camera of a viewpoint: x_camera = x_world R + T, in PyTorch3D's axes."""
    own = frame.get("viewpoint")
    if not isinstance(own, dict):
        raise Unusable(frame.error("viewpoint", "is missing; remove the frame"), "no pose")
    view = Frame(frame.file, {}, own, frame.index, "viewpoint of frame ")
    rotation, place = view.array("R", (3, 3)), view.array("T", (3,))
    focal, centre = view.array("focal_length", (2,)), view.array("principal_point", (2,))
    half = np.array(size) / 2
    kind = own.get("intrinsics_format") or NORMALISED
    if kind not in (NORMALISED, ISOTROPIC):
        raise view.error("intrinsics_format", f"is {quoted(kind, 40)}; {ISOTROPIC} is known")
    scale = half if kind == NORMALISED else half.min()
    focal, centre = focal * scale, half - centre * scale
    if not (focal > 1 / MOST).all():
        raise view.error("focal_length", f"is {focal.min():g} pixels; must be above 0")
    to_world = rotation @ CV_FROM_P3D
    pose = rigid(np.column_stack([to_world, -rotation @ place]), partial(view.error, "R"))
    return Camera(pose, *(float(v) for v in (*focal, *centre)), *size)


def _set_list(folder):
    """{split: paths of images} of the sequence, each image in one split only; None without a list.
    Version 1 calls the splits known and unseen; in version 2, lists of many views go first.
    """
    category = folder.parent
    old = category / "set_lists.json"
    if old.is_file():
        sets = _listed(old, folder.name)
        kinds = {"train": "known", "test": "unseen"}
        named = {split: [sets[name] for name in sets if kinds[split] in name] for split in kinds}
        return _disjoint({split: set().union(*paths) for split, paths in named.items()})
    files = sorted((category / "set_lists").glob("*.json"), key=lambda f: ("many" not in f.name, f))
    lists = (_disjoint(_listed(file, folder.name)) for file in files)
    return next(filter(None, lists), None)


def _listed(file, sequence):
    """{name of a set: paths of the sequence's images in it}. Raises UserError."""
    data = read_json(file)
    try:
        return {
            name: {path for owner, _, path in rows if owner == sequence}
            for name, rows in data.items()
        }
    except (AttributeError, TypeError, ValueError):
        raise UserError(
            f"{file}: must be lists of [sequence, frame number, path]; copy it again"
        ) from None


def _disjoint(sets):
    """The splits that have frames, without frames that train has, too; None without training or
    test frames.
    """
    train = sets.get("train", set())
    others = {name: sets.get(name, set()) - train for name in ("val", "test")}
    splits = {"train": train} | {name: paths for name, paths in others.items() if paths}
    return splits if train and "test" in splits else None
