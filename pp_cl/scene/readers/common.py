"""What several readers do: find an image that a file names, and split the photographs of a format
that knows no splits.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.files.image import ENDINGS

HELD_OUT = 8  # one photograph of so many, the first among them, as LLFF and 3DGS do
SPLITS = ["test", "train"]
Item = TypeVar("Item")


def find_image(
    folder: Path, given: str, fail: Callable[[str], UserError], endings: Sequence[str] = ("",)
) -> str:
    """Path relative to the scene's folder of the image that a file there calls `given`, with the
    first of the endings that exists.

    fail(text) makes the error that names the file and the key. Raises it for a path that leaves the
    folder, by a symbolic link or otherwise, and for one where no image is.
    """
    try:
        root = os.path.realpath(folder)
        for ending in endings:
            path = os.path.realpath(os.path.join(root, given + ending))
            if os.path.commonpath([root, path]) != root:
                raise fail(f"{given!r} leaves the scene's folder; move the image into it")
            if os.path.isfile(path):
                return os.path.relpath(path, root).replace(os.sep, "/")
    except (OSError, ValueError) as error:  # a name too long, a zero byte
        raise fail(f"{given[:80]!r} is not a usable path ({error})") from error
    tried = "".join(f", nor with {ending} added" for ending in endings if ending)
    raise fail(f"no image at {given[:80]!r}{tried}; copy it there or remove the frame")


def listing(items: Sequence[Item]) -> Iterable[Item]:
    """The items, of which a progress bar shows on a terminal where there are thousands."""
    return tqdm(items, "listing", unit="image", leave=False, disable=None, delay=2)


def folder_images(folder: Path, name: str) -> list[str]:
    """Paths relative to the scene's folder of the images in its folder `name`, sorted,
    hidden files left out. Raises UserError where there are none.
    """
    files = sorted((folder / name).glob("*"))
    found = [
        file.name
        for file in files
        if file.suffix.lower() in ENDINGS and file.is_file() and not file.name.startswith(".")
    ]
    if not found:
        raise UserError(f"{folder / name}: no images in it; copy them there")
    fail = partial(_error, folder / name)
    return [find_image(folder, f"{name}/{image}", fail) for image in found]


def of_stem(folder: Path, name: str, stem: str) -> str:
    """Path relative to the scene's folder of the image in its folder `name` with this stem. Raises
    UserError where there is none.
    """
    endings = [ending for ending in ENDINGS if (folder / name / f"{stem}{ending}").is_file()]
    if not endings:
        raise UserError(f"{folder / name}: no mask {stem}.png; add it, or remove the folder")
    return find_image(folder, f"{name}/{stem}{endings[0]}", partial(_error, folder / name))


def _error(place, text):
    return UserError(f"{place}: {text}")


def check_split(place: Path, split: str, present: Sequence[str]) -> None:
    """Raise UserError naming the place where a scene has no such split."""
    if split not in present:
        raise UserError(
            f"{place}: no split {split}; the splits of this scene are {', '.join(present)}"
        )


def hold_out(items: Sequence[Item], split: str) -> list[Item]:
    """The items of split train or test, of a format without splits: test is every eighth."""
    is_test = split == "test"
    return [item for index, item in enumerate(items) if (index % HELD_OUT == 0) == is_test]
