"""Reader of scenes in the format of NeRF-synthetic, transforms_<split>.json, extended by
nerfstudio's keys: intrinsics per frame, principal point, near and far.
"""

from pathlib import Path

from pp_cl.errors import UserError
from pp_cl.files.image import image_size
from pp_cl.scene.camera import Camera
from pp_cl.scene.readers.frame import Frame, pinhole, read_json

FILES = "transforms_train.json"


def recognises(folder: Path) -> bool:
    """True if the folder holds a transforms_<split>.json."""
    return any(folder.glob("transforms_*.json"))


def splits(folder: Path) -> list[str]:
    """The names of the splits that the folder holds."""
    return sorted(f.stem.removeprefix("transforms_") for f in folder.glob("transforms_*.json"))


def read_split(folder: Path, split: str) -> list[tuple[str, Camera, tuple[float, float] | None]]:
    """[(image path relative to the folder, Camera, (near, far))] of transforms_<split>.json.

    The last is None for a frame without near and far. Raises UserError naming the file and the key
    that is missing or wrong.
    """
    file = folder / f"transforms_{split}.json"
    if not file.is_file():
        present = ", ".join(splits(folder))
        raise UserError(f"{file}: no such file; the splits of this scene are {present}")
    data = read_json(file)
    if not isinstance(data, dict):
        raise UserError(f"{file}: must hold a JSON object with the key frames")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{file}: frames: must be a list of one frame or more")
    return [
        _read_frame(folder, Frame(file, data, frame, index)) for index, frame in enumerate(frames)
    ]


def _read_frame(folder, frame):
    """(image path relative to the folder, Camera, (near, far) or None) of one frame."""
    name = _image_name(folder, frame)
    width, height = _size(folder, name, frame)
    return name, pinhole(frame, width, height), _depth_range(frame)


def _image_name(folder, frame):
    """Path of the frame's image relative to the folder, which it may not leave, not even by a
    symbolic link.
    """
    given = frame.get("file_path")
    if not isinstance(given, str) or not given:
        raise frame.error("file_path", "must be the path of an image")
    try:
        root = folder.resolve()
        paths = [(root / candidate).resolve() for candidate in (given, given + ".png")]
        if not all(path.is_relative_to(root) for path in paths):
            raise frame.error(
                "file_path", f"{given!r} leaves the scene's folder; move the image into it"
            )
        found = [path for path in paths if path.is_file()]
    # a loop of links, a name too long, a zero byte
    except (OSError, RuntimeError, ValueError) as error:
        raise frame.error("file_path", f"{given[:80]!r} is not a usable path ({error})") from error
    if not found:
        raise frame.error(
            "file_path",
            f"no image at {given!r}, nor with .png added; copy it there or remove the frame",
        )
    return found[0].relative_to(root).as_posix()


def _size(folder, name, frame):
    """(width, height) of the image; w and h must agree, since the other intrinsics are in the same
    pixels.
    """
    size = image_size(folder / name)
    for key, actual in zip(("w", "h"), size, strict=True):
        stated = frame.number(key)
        if stated is not None and stated != actual:
            raise frame.error(
                key,
                f"is {stated:g}, but {name} has {size[0]}x{size[1]} pixels; restore the image's"
                " size, or scale fl_x, fl_y, cx, cy, w and h to it",
            )
    return size


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
