"""Reader of scenes in the formats of NeRF-synthetic (transforms_<split>.json) and nerfstudio
(transforms.json), with the keys of both, and of sdfstudio; and a writer of the first format.
"""

import math
import warnings
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from pp_cl.engine.views import View
from pp_cl.errors import Unusable, UserError
from pp_cl.files.atomic import atomic_folder, write_json
from pp_cl.files.image import image_size, same_shape, write_png
from pp_cl.files.untrusted import opened_regular
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import LeftOut, usable
from pp_cl.scene.readers.common import (
    SPLITS,
    checked_box,
    fail_at,
    fitted,
    hold_out,
    numbers,
    progress,
    read_json,
)
from pp_cl.scene.readers.frame import GL_FROM_CV, Frame, frame_keys, lens_distortion, pinhole

FILES = "transforms_train.json or transforms.json"
STATES = "camera-to-world", "opengl"
SINGLE, SDFSTUDIO = "transforms.json", "meta_data.json"
ODD = 1 / 8  # share of the images that may have another shape by mistake
NAMED = ("train", "val", "test")  # splits that transforms.json may list as <split>_filenames


def recognises(folder: Path) -> bool:
    """Whether the folder holds a transforms.json or a transforms_<split>.json."""
    return _single(folder) is not None or bool(_split_files(folder))


def splits(folder: Path) -> list[str]:
    """The names of the splits that the folder holds, except splits whose images are all missing."""
    if files := _split_files(folder):
        return sorted(s for s, file in files.items() if s == "train" or _has_image(folder, file))
    listed = [split for split in NAMED if f"{split}_filenames" in _read(_single(folder))]
    return sorted(listed) or SPLITS


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[ImageFile]:
    """The images of transforms_<split>.json, or the images of transforms.json that its
    <split>_filenames lists; without such lists, every eighth is for test. Raises UserError naming
    the file and the key.
    """
    files = _split_files(folder)
    file = files[split] if files else _single(folder)
    data = _read(file)
    unclear: dict[str, Unusable] = {}
    frames: dict[str, Frame] = {}  # by the name of the image, or its path if there is no image
    for index, own in enumerate(progress(data["frames"])):
        frame = Frame(file, data, own if isinstance(own, dict) else {}, index)
        name = _image(folder, frame) or _path(frame)
        if frames.setdefault(name, frame).get("transform_matrix") != frame.get("transform_matrix"):
            text = frame.error("file_path", f"{name!r} is listed with two poses; remove one")
            unclear[name] = Unusable(text, "two poses")
    if len({str(frame.get("time")) for frame in frames.values()}) > 1:
        what = "frames differ in time, but motion is not modelled: moving parts will be blurred"
        warnings.warn(f"{file}: {what}", stacklevel=1)
    chosen = list(frames) if files else _of_split(file, data, frames, split)

    def read(name):
        if name in unclear:
            raise unclear[name]
        return _image_file(folder, frames[name])

    return _of_one_shape(file, data, list(usable(chosen, read, str, left_out)), left_out)


def box(folder: Path) -> np.ndarray | None:
    """(2, 3) box around the object, which a transforms.json states as its `aabb`, or None."""
    file = _single(folder)
    corners = None if _split_files(folder) else _read(file).get("aabb")
    return None if corners is None else checked_box(corners, fail_at(file, "aabb"))


def _single(folder):
    """The transforms.json, or sdfstudio's file instead of it; None without either."""
    files = [folder / name for name in (SINGLE, "transform.json")]
    with suppress(OSError), opened_regular(folder / SDFSTUDIO) as opened:
        files += [folder / SDFSTUDIO] if b'"camtoworld"' in opened.read(2**16) else []
    return next((file for file in files if file.is_file()), None)


def _split_files(folder):
    """{split: transforms_<split>.json}; {} if they only accompany a transforms.json."""
    present = [file for file in sorted(folder.glob("transform*_*.json")) if file.is_file()]
    files = {file.stem.partition("_")[2]: file for file in present}
    return {} if _single(folder) and "train" not in files else files


def _read(file):
    """The JSON object in a transforms file, with a list of frames. Raises UserError."""
    data = read_json(file)
    if not isinstance(data, dict):
        raise UserError(f"{file}: must hold a JSON object with the key frames")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{file}: frames: must be a list of at least one frame")
    if file.name == SDFSTUDIO:
        frames = [_of_sdfstudio(frame) for frame in frames if isinstance(frame, dict)]
        return {"w": data.get("width"), "h": data.get("height"), "frames": frames}
    return data


def _of_sdfstudio(own):
    """A frame of sdfstudio, whose axes are OpenCV's, converted to nerfstudio's keys and axes."""
    pose, lens = numbers(own.get("camtoworld"), (4, 4)), numbers(own.get("intrinsics"))
    keys = {"file_path": own.get("rgb_path"), "mask_path": own.get("foreground_mask")}
    if pose is not None:
        keys["transform_matrix"] = (pose @ GL_FROM_CV).tolist()
    if lens is not None and lens.ndim == 2 and min(lens.shape) > 2:
        (fx, _, cx), (_, fy, cy) = lens[:2, :3].tolist()
        keys |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return keys


def _has_image(folder, file):
    """Whether any frame of a file has its image; True for a broken file, which reading refuses."""
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        return True
    parsed = (Frame(file, data, own, i) for i, own in enumerate(frames) if isinstance(own, dict))
    return any(_image(folder, frame) for frame in parsed)


def _image(folder, frame):
    """The name of a frame's image, or None if there is no such image."""
    try:
        return frame.image("file_path", folder)
    except Unusable:
        return None


def _path(frame):
    """The path of its image that a frame states, or words on the frame if it states none."""
    path = frame.get("file_path")
    return _plain(path) if isinstance(path, str) else f"frames[{frame.index}]"


def _plain(path):
    return PurePosixPath(path.replace("\\", "/")).as_posix()


def _of_split(file, data, frames, split):
    """The image names of the frames of a transforms.json that belong to a split, sorted."""
    ordered = sorted(frames)
    names = data.get(f"{split}_filenames")
    if names is None:
        return hold_out(ordered, split, [file.parent / name for name in ordered])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{file}: {split}_filenames: must be a list of images' paths")
    wanted, paths = set(map(_plain, names)), {name: _path(frames[name]) for name in ordered}
    missing = wanted - {*ordered, *paths.values()}
    if missing or not wanted:
        what = f"no frame has the path {min(missing)!r}" if missing else "is empty"
        raise UserError(f"{file}: {split}_filenames: {what}; list images of the frames")
    return [name for name in ordered if wanted & {name, paths[name]}]


def _of_one_shape(file, data, image_files, left_out):
    """The images with the shape that nearly all have; others go to left_out. This matters only if
    one angle of view is stated for all.
    """
    if data.get("camera_angle_x") is None or {"fl_x", "w"} & data.keys():
        return image_files
    sizes = [(image_file.camera.width, image_file.camera.height) for image_file in image_files]
    counts = Counter(sizes)
    usual = max(
        counts,
        key=lambda size: sum(n for other, n in counts.items() if same_shape(size, other)),
        default=(),
    )
    others = [
        image_file.name
        for image_file, size in zip(image_files, sizes, strict=True)
        if not same_shape(size, usual)
    ]
    if len(others) > ODD * len(sizes):
        return image_files
    for name in others:
        text = f"{file}: {name} has another shape than the others, for which camera_angle_x is"
        left_out.append((name, Unusable(f"{text}; write it anew", "an image of another shape")))
    return [image_file for image_file in image_files if image_file.name not in others]


def _image_file(folder, frame):
    """The ImageFile of one frame, with its camera scaled to the image. Raises Unusable."""
    name = frame.image("file_path", folder)
    if name is None:
        raise frame.error("file_path", "is missing; add the path of the image")
    mask = frame.image("mask_path", folder)
    stated = frame.number("w", above=0), frame.number("h", above=0)
    size = image_size(folder / name, None if None in stated else stated)
    whole = [stated_side or side for stated_side, side in zip(stated, size, strict=True)]
    camera = fitted(pinhole(frame, *whole), size, partial(frame.error, "w"))
    near_far = frame.number("near", above=0), frame.number("far", above=0)
    is_stated = near_far != (None, None)
    if is_stated and (None in near_far or near_far[0] >= near_far[1]):
        key = "near" if near_far[0] is None else "far"
        raise frame.error(key, "near and far must both be given, far above near, or neither")
    return ImageFile(name, camera, near_far if is_stated else None, mask, lens_distortion(frame))


def write_scene(splits: dict[str, list[View]], folder: Path | str) -> None:
    """Write the stored images of views as a scene in NeRF-synthetic's format, with nerfstudio's
    keys, too. Raises UserError if the folder exists and is not empty, or cannot be written.
    """
    with atomic_folder(Path(folder)) as unfinished:
        for split, views in splits.items():
            frames = []
            for view in views:
                path = Path(view.name).with_suffix("")
                (unfinished / path).parent.mkdir(parents=True, exist_ok=True)
                write_png(unfinished / f"{path}.png", view.image)
                frame = {"file_path": f"./{path.as_posix()}", **frame_keys(view.stored_camera)}
                if view.depth_range:
                    frame["near"], frame["far"] = view.depth_range
                frames.append(frame)
            camera = views[0].stored_camera
            angle = 2 * math.atan(0.5 * camera.width / camera.fx)
            data = {"camera_angle_x": angle, "frames": frames}
            write_json(unfinished / f"transforms_{split}.json", data)
