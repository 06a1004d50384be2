"""Reader of scenes in the format of NeRF-synthetic, transforms_<split>.json, and of nerfstudio,
transforms.json, with the keys of both: intrinsics and distortion per frame, masks, near and far;
and a writer of the former.
"""

import math
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from pp_cl.errors import Unusable, UserError
from pp_cl.files.atomic import atomic_folder, write_json
from pp_cl.files.image import image_size, write_png
from pp_cl.scene.readers.common import (
    SPLITS,
    checked_box,
    fail_at,
    fitted,
    hold_out,
    listing,
    read_json,
)
from pp_cl.scene.readers.found import CASED_ENDINGS, Notes
from pp_cl.scene.readers.frame import Frame, distortion, frame_keys, pinhole
from pp_cl.scene.views import Photograph, View

FILES = "transforms_train.json or transforms.json"
SINGLE = "transforms.json"
NAMED = ("train", "val", "test")  # splits that transforms.json may list as <split>_filenames


def recognises(folder: Path) -> bool:
    """True if the folder holds a transforms_<split>.json or a transforms.json."""
    return (folder / SINGLE).is_file() or bool(_split_files(folder))


def splits(folder: Path) -> list[str]:
    """The names of the splits that the folder holds."""
    files = _split_files(folder)
    if files:
        return sorted(f.stem.removeprefix("transforms_") for f in files)
    listed = [split for split in NAMED if f"{split}_filenames" in _read(folder / SINGLE)]
    return sorted(listed) or SPLITS


def read_split(folder: Path, split: str, notes: Notes) -> list[Photograph]:
    """The photographs of transforms_<split>.json; or those of transforms.json that its
    <split>_filenames names, and where it has no such lists every eighth for test, the others for
    train.

    Raises UserError naming the file and the key that is missing or wrong.
    """
    file = folder / (f"transforms_{split}.json" if _split_files(folder) else SINGLE)
    data, read = _read(file), {}
    for index, own in enumerate(listing(data["frames"])):
        frame, one = Frame(file, data, own, index), None
        name = given = _plain(str(frame.get("file_path")))
        try:
            one = _read_frame(folder, frame)
            name = one.name
        except Unusable as error:
            one = error
        if name in read:
            raise frame.error("file_path", f"{name!r} stands there twice; remove one")
        read[name] = given, one
    chosen = list(read)
    if file.name == SINGLE:
        chosen = _of_split(file, data, {name: given for name, (given, _) in read.items()}, split)
    return list(notes.usable(chosen, lambda name: _usable(read[name][1]), str))


def box(folder: Path) -> np.ndarray | None:
    """(2, 3) box around the object that a transforms.json states as its `aabb`, None where there is
    none. Raises UserError naming the file.
    """
    file = folder / SINGLE
    corners = None if _split_files(folder) else _read(file).get("aabb")
    return None if corners is None else checked_box(corners, fail_at(file, "aabb"))


def _split_files(folder):
    """The transforms_<split>.json of a scene that has one for training, or no transforms.json: else
    they are copies beside it.
    """
    if (folder / SINGLE).is_file() and not (folder / "transforms_train.json").is_file():
        return []
    return [file for file in folder.glob("transforms_*.json") if file.is_file()]


def _read(file):
    """The object of a transforms file, whose frames are a list."""
    data = read_json(file)
    if not isinstance(data, dict):
        raise UserError(f"{file}: must hold a JSON object with the key frames")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{file}: frames: must be a list of one frame or more")
    return data


def _plain(path):
    return PurePosixPath(path.replace("\\", "/")).as_posix()


def _usable(found):
    if isinstance(found, Unusable):
        raise found
    return found


def _of_split(file, data, given, split):
    """Those of a transforms.json's names, {name: as its frame has it}, that belong to a split, in
    their order.
    """
    ordered = sorted(given)
    names = data.get(f"{split}_filenames")
    if names is None:
        return hold_out(ordered, split)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{file}: {split}_filenames: must be a list of images' paths")
    wanted = set(map(_plain, names))
    missing = wanted - {*ordered, *given.values()}
    if missing or not wanted:
        what = f"{min(missing)!r} is the path of no frame" if missing else "is empty"
        raise UserError(f"{file}: {split}_filenames: {what}; list images of the frames")
    return [name for name in ordered if wanted & {name, given[name]}]


def _read_frame(folder, frame):
    """The Photograph of one frame."""
    name, mask = (
        frame.image("file_path", folder, ["", *CASED_ENDINGS]),
        frame.image("mask_path", folder),
    )
    if name is None:
        raise frame.error("file_path", "is missing; add the path of the image")
    return Photograph(
        name, _camera(folder, name, frame), _depth_range(frame), mask, distortion(frame)
    )


def _camera(folder, name, frame):
    """The Camera, of the image's size."""
    stated = frame.number("w", above=0), frame.number("h", above=0)
    size = image_size(folder / name, None if None in stated else stated)
    whole = [one or side for one, side in zip(stated, size, strict=True)]
    return fitted(pinhole(frame, *whole), size, partial(frame.error, "w"))


def _depth_range(frame):
    """(near, far), or None if neither is given."""
    near, far = frame.number("near", above=0), frame.number("far", above=0)
    if near is None and far is None:
        return None
    if near is None or far is None:
        raise frame.error(
            "near" if near is None else "far", "is missing; give both near and far, or neither"
        )
    if far <= near:
        raise frame.error("far", f"is {far:g}; must be above near, {near:g}")
    return near, far


def write_scene(splits: dict[str, list[View]], folder: Path | str) -> None:
    """Write the stored images of views as a scene of NeRF-synthetic; the folder appears when it is
    complete. Raises UserError if it exists and is not empty, or cannot be written.
    """
    with atomic_folder(Path(folder)) as unfinished:
        write_splits(splits, unfinished)


def write_splits(splits: dict[str, list[View]], folder: Path) -> None:
    """The same into a folder that exists. Every frame has nerfstudio's fl_x, fl_y, cx, cy, w, h,
    and near and far if the views state them.
    """
    for split, views in splits.items():
        frames = []
        for view in views:
            path = Path(view.name).with_suffix("")
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            write_png(folder / f"{path}.png", view.image)
            frame = {"file_path": f"./{path.as_posix()}", **frame_keys(view.stored_camera)}
            if view.depth_range:
                frame["near"], frame["far"] = view.depth_range
            frames.append(frame)
        camera = views[0].stored_camera
        angle = 2 * math.atan(0.5 * camera.width / camera.fx)
        data = {"camera_angle_x": angle, "frames": frames}
        write_json(folder / f"transforms_{split}.json", data)
