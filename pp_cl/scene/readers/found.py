"""What the names in a scene's files mean: the image of a name, the mask of an image; and what was
done so that a scene can be read, which is told once for each kind.
"""

import os
import posixpath
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TypeVar

from pp_cl.errors import Unusable, UserError, listing
from pp_cl.files.image import ENDINGS

# where programs put the images that a name may mean, in their order, beside images_2, images_4 ...
IMAGE_FOLDERS = ("images", "image", "input", "rgb", "dense/0/images", "dense/images")
MASK_FOLDERS = ("masks", "mask")
IGNORE_FOLDERS = ("ignore",)  # of masks that are white where an image says nothing
CASED_ENDINGS = [cased for ending in ENDINGS for cased in (ending, ending.upper())]

Item = TypeVar("Item")
Result = TypeVar("Result")
Fail = Callable[[str], UserError]  # makes the error that names the file and the key


class Notes:
    """What was done so that a scene can be read. left_out, done: {kind: names}, the views that are
    left out, and those for which something else was done.
    """

    def __init__(self) -> None:
        self.left_out: dict[str, list[str]] = {}
        self.done: dict[str, list[str]] = {}
        self._first: UserError | None = None

    def usable(
        self,
        items: Iterable[Item],
        read: Callable[[Item], Result | Unusable],
        name: Callable[[Item], str],
    ) -> Iterator[Result]:
        """What read() gives of the items, without those for which it raises or gives an Unusable:
        they are left out.
        """
        for item in items:
            try:
                found = read(item)
            except Unusable as error:
                found = error
            if isinstance(found, Unusable):
                self.left_out.setdefault(found.why, []).append(name(item))
                self._first = self._first or found
            else:
                yield found

    def check(self, left: int, least: int = 1) -> None:
        """Raise the error of the first view that was left out where fewer than `least`, or less
        than half, are left.
        """
        gone = sum(map(len, self.left_out.values()))
        if self._first and left < max(least, gone):
            raise self._first

    def lines(self, left: int) -> list[str]:
        """One line for each kind. left: the views that are not left out."""
        count = left + sum(map(len, self.left_out.values()))
        return [
            f"{len(names)} of {count} views left out: {why} ({listing(names)})"
            for why, names in self.left_out.items()
        ] + [f"{what} ({listing(names)})" for what, names in self.done.items()]


# --------------------------------------------------------------------------------------------------


def find_image(
    folder: Path, given: str, fail: Fail, endings: Sequence[str] = ("",), kind: str = "image"
) -> str:
    """Path relative to the scene's folder of the image that a file there calls `given`.

    In this order: as it is written, with the first of the endings that exists, also as Windows
    writes paths; then for each tail of the path, the longest first, beside the file and in
    IMAGE_FOLDERS: the name, with another ending (those that may have alpha first), in another case,
    without an ending that stands there twice. Links that lie in the folder are followed. kind:
    image, or mask, which is looked for in MASK_FOLDERS, never where images are.

    Raises fail(text) for a path that leaves the folder, Unusable with its text where no image is.
    """
    root = os.path.realpath(folder)
    try:
        for form in dict.fromkeys((given, given.replace("\\", "/"))):
            if not os.path.isabs(form) and posixpath.normpath(form).split("/")[0] == "..":
                raise fail(
                    f"{given[:80]!r} leaves the scene's folder; copy the image into it and write"
                    " its path from there"
                )
            for ending in endings:
                path = os.path.join(root, form + ending)
                if os.path.isfile(path) and (inside := _inside(root, path)):
                    return inside
        parts = [p for p in given.replace("\\", "/").split("/") if p not in ("", ".")]
        for start in range(len(parts)):
            *above, name = parts[start:]
            for place in (".", *(MASK_FOLDERS if kind == "mask" else _image_folders(root))):
                if kind == "mask" and place == "." and not above:
                    continue
                there = posixpath.normpath(posixpath.join(place, *above))
                if found := _alike(os.path.join(root, there), name):
                    return posixpath.normpath(posixpath.join(there, found))
    except (OSError, ValueError) as error:  # a name too long, a zero byte
        raise fail(f"{given[:80]!r} is not a usable path ({error})") from error
    bare = ", with or without the ending of an image" * (len(endings) > 1)
    text = f"no {kind} at {given[:80]!r} in {folder}{bare}; copy it there or remove the frame"
    raise Unusable(fail(text), f"no {kind}")


def numbered(names: Sequence[str], count: int) -> dict[int, str] | None:
    """{place: name} of sorted names in a list of `count`, of which some are gone: their places are
    the numbers in their names, counted from the first one's. None where these say nothing: it may
    be all of the first, or of the last, that are gone.
    """
    if len(names) == count:
        return dict(enumerate(names))
    found = [re.search(r"(\d+)\D*$", PurePosixPath(name).stem) for name in names]
    numbers = [int(one[1]) if one else -1 for one in found]
    low, high = min(numbers), max(numbers)
    is_whole = low > -1 and len(set(numbers)) == len(numbers) and high - low == count - 1
    return {n - low: name for n, name in zip(numbers, names, strict=True)} if is_whole else None


def _inside(root, path):
    """A path relative to the root, of what a link leads to if that is inside, too; None of an
    absolute path outside.
    """
    for one in (os.path.realpath(path), os.path.normpath(path)):
        if os.path.commonpath([root, one]) == root:
            return os.path.relpath(one, root).replace(os.sep, "/")
    return None


def _image_folders(root):
    """IMAGE_FOLDERS that there are, in any case, and images_N, the largest images first."""
    entries = _entries(root, os.stat(root).st_mtime_ns)
    reduced = {
        entry: int(number)
        for entry in entries
        if (number := entry.removeprefix("images_")).isdecimal() and number != entry
    }
    inside = {entry.lower(): entry for entry in reversed(entries)}
    usual = (inside.get(place, place) for place in IMAGE_FOLDERS)
    places = (*usual, *sorted(reduced, key=reduced.__getitem__))
    return [place for place in places if os.path.isdir(os.path.join(root, place))]


@lru_cache(maxsize=256)
def _entries(folder, time):
    """What lies in a folder. time: of its last change, so that what is kept here stays true."""
    return sorted(os.listdir(folder))


def _alike(folder, name):
    """The file in a folder that a name means; None where there is none, or several."""
    if not os.path.isdir(folder):
        return None
    entries = _entries(folder, os.stat(folder).st_mtime_ns)
    stem, ending = os.path.splitext(name)
    stem = name if ending.lower() not in ENDINGS else stem
    once = os.path.splitext(stem)[0] if stem.lower().endswith(ENDINGS) else stem
    for names in ([name], *([one, *(one + e for e in CASED_ENDINGS)] for one in (stem, once))):
        for one in names:
            if one in entries and os.path.isfile(os.path.join(folder, one)):
                return one
        lower = {one.lower() for one in names}
        found = [one for one in entries if one.lower() in lower]
        found = [one for one in found if one.lower().endswith(ENDINGS)]
        if len(found) == 1 and os.path.isfile(os.path.join(folder, found[0])):
            return found[0]
    return None


# Masks --------------------------------------------------------------------------------------------


def mask_names(image: str) -> list[str]:
    """What the mask of an image may be called in a folder of masks, as programs write them: its
    path there with .png added, or its stem, maybe with _mask behind or mask_ before it, with the
    ending of any image, of which .png may stand behind another.
    """
    path = PurePosixPath(image)
    stems = (path.stem, f"{path.stem}_mask", f"mask_{path.stem}")
    names = [f"{stem}{ending}" for stem in stems for ending in CASED_ENDINGS]
    names += [f"{path.stem}{ending}.png" for ending in CASED_ENDINGS]
    return [f"{image}.png", *(str(path.with_name(name)) for name in names)]


def find_masks(
    folder: Path, images: Sequence[str], places: Sequence[str] = MASK_FOLDERS
) -> dict[str, str] | None:
    """{image: its mask} of those that have one in the scene's folder of masks, both relative to the
    scene's folder; None where there is no such folder. places: what it may be called.

    A mask lies in the same tree, with or without the folder of images above it, and is named as
    mask_names() has it; where names of images are there once only, it may also lie at the top of
    its folder, or have the same number as DTU has it. Raises UserError where no image has one.
    """
    place = folder_named(folder, places)
    if place is None:
        return None
    trees = {image: _in_tree(image) for image in images}
    often = Counter(PurePosixPath(image).name for image in images)
    numbers = _numbered(folder / place)
    found = {}
    for image, tree in trees.items():
        name = PurePosixPath(tree).name
        names = [*mask_names(tree), *mask_names(image)]
        names += mask_names(name) if often[name] == 1 else []
        # a name that is too long with .png is no file, where Path.is_file raises
        mask = next((one for one in names if os.path.isfile(folder / place / one)), None)
        stem = PurePosixPath(name).stem
        mask = mask or (numbers.get(int(stem)) if stem.isdecimal() and often[name] == 1 else None)
        if mask:
            found[image] = f"{place}/{mask}"
    if not found:
        first = PurePosixPath(place) / f"{trees[images[0]]}.png"
        usual = first.with_suffix("").with_suffix(".png")
        raise UserError(
            f"{folder / place}: no mask {first} or {usual}, nor one of another image; add them,"
            " or do without the folder"
        )
    return found


def folder_named(folder: Path, names: Sequence[str]) -> str | None:
    """What in a folder is a folder with one of the names, in their order, whatever their case."""
    inside = {entry.lower(): entry for entry in sorted(os.listdir(folder), reverse=True)}
    found = (inside.get(name, name) for name in names)
    return next((name for name in found if (folder / name).is_dir()), None)


def holds_images(folder: Path) -> bool:
    """Whether a folder has images, or a folder for images, in it."""
    inside = (entry.lower().endswith(ENDINGS) for entry in os.listdir(folder))
    return bool(_image_folders(folder)) or any(inside)


def image_folder(folder: Path, names: Sequence[str] = IMAGE_FOLDERS) -> str:
    """Where the images of a format lie that does not name them: the first of the names that is a
    folder there, else images_N with the largest images; where none is, the first name.
    """
    reduced = [place for place in _image_folders(folder) if place.lower() not in IMAGE_FOLDERS]
    return folder_named(folder, names) or next(iter(reduced), names[0])


def _in_tree(image):
    """Its path in the folder of images."""
    for place in sorted(IMAGE_FOLDERS, key=len, reverse=True):
        if image.lower().startswith(f"{place}/"):
            return image[len(place) + 1 :]
    first, _, rest = image.partition("/")
    return rest if first.startswith("images_") and rest else image


def _numbered(folder):
    """{number: name} of the images in a folder whose names are whole numbers."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in ENDINGS]
    return {int(file.stem): file.name for file in files if file.stem.isdecimal()}
