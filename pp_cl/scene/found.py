"""What is found of what a scene's files name: the image of a name, the mask of an image."""

import os
import posixpath
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TypeVar

from pp_cl.errors import Unusable, UserError
from pp_cl.files.atomic import sha256_of
from pp_cl.files.image import ENDINGS

# where programs put the images that a name may mean, in their order, beside images_2, images_4 ...
IMAGE_FOLDERS = ("images", "image", "input", "rgb", "dense/0/images", "dense/images")
MASK_FOLDERS = ("masks", "mask")
IGNORE_FOLDERS = ("ignore",)  # of masks that are white where an image says nothing
Item = TypeVar("Item")
Result = TypeVar("Result")
Fail = Callable[[str], UserError]  # makes the error that names the file and the key
LeftOut = list[tuple[str, UserError]]  # the names of views that cannot be used, and why


def usable(
    items: Iterable[Item],
    read: Callable[[Item], Result],
    name: Callable[[Item], str],
    left_out: LeftOut,
) -> Iterator[Result]:
    """What read() gives of the items; where it raises UserError, their name() goes to left_out."""
    for item in items:
        try:
            yield read(item)
        except UserError as error:
            left_out.append((name(item), error))


def find_image(folder: Path, given: str, fail: Fail, kind: str = "image") -> str:
    """Path relative to the scene's folder of the image that a file there calls `given`: as it is
    written, or what is _alike() for the tails of the path, the longest first, beside the file and
    in IMAGE_FOLDERS, for the kind mask in MASK_FOLDERS. Raises fail(text) for a path that leaves
    the folder, Unusable with its text where no image is.
    """
    root = os.path.realpath(folder)
    try:
        for form in dict.fromkeys((given, given.replace("\\", "/"))):
            if not os.path.isabs(form) and posixpath.normpath(form).split("/")[0] == "..":
                raise fail(
                    f"{given[:80]!r} leaves the scene's folder; copy the image into it and write"
                    " its path from there"
                )
            path = os.path.join(root, form)
            if os.path.isfile(path) and (inside := _inside(root, path)):
                return inside
        parts = [p for p in given.replace("\\", "/").split("/") if p not in ("", ".")]
        places = MASK_FOLDERS if kind == "mask" else _image_folders(root)
        for start in range(len(parts)):
            *above, name = parts[start:]
            for place in (".", *places):
                if kind == "mask" and place == "." and not above:
                    continue
                there = posixpath.normpath(posixpath.join(place, *above))
                if found := _alike(os.path.join(root, there), name):
                    return posixpath.normpath(posixpath.join(there, found))
    except (OSError, ValueError) as error:  # a name too long, a zero byte
        raise fail(f"{given[:80]!r} is not a usable path ({error})") from error
    text = f"no {kind} at {given[:80]!r} in {folder}; copy it there or remove the frame"
    raise Unusable(fail(text), f"no {kind}")


def pictures_of(files: Sequence[Path]) -> list[object]:
    """What is the same for files that are copies of one picture, and differs for others: the path,
    or the digest where two have one size.
    """
    sizes = [file.stat().st_size if file.is_file() else -1 for file in files]
    often = Counter(sizes)
    return [
        sha256_of(file).digest() if size >= 0 and often[size] > 1 else file
        for file, size in zip(files, sizes, strict=True)
    ]


def numbered(names: Sequence[str], count: int) -> dict[int, str] | None:
    """{place: name} of sorted names in a list of `count`, of which some are gone, by the numbers in
    the names, counted from the first one's; None where these say nothing.
    """
    if len(names) == count:
        return dict(enumerate(names))
    found = [re.search(r"(\d+)\D*$", PurePosixPath(name).stem) for name in names]
    numbers = [int(one[1]) if one else -1 for one in found]
    low, high = min(numbers), max(numbers)
    is_whole = low > -1 and len(set(numbers)) == len(numbers) and high - low == count - 1
    return {n - low: name for n, name in zip(numbers, names, strict=True)} if is_whole else None


def _inside(root, path):
    """A path relative to the root, of what a link leads to if that is inside; None outside."""
    for one in (os.path.realpath(path), os.path.normpath(path)):
        if os.path.commonpath([root, one]) == root:
            return os.path.relpath(one, root).replace(os.sep, "/")
    return None


def _image_folders(root):
    """IMAGE_FOLDERS that there are, in any case, and images_N, the largest images first."""
    entries = sorted(os.listdir(root))
    reduced = [entry for entry in entries if re.fullmatch(r"images_\d+", entry)]
    inside = {entry.lower(): entry for entry in reversed(entries)}
    usual = (inside.get(place, place) for place in IMAGE_FOLDERS)
    places = (*usual, *sorted(reduced, key=lambda entry: int(entry[len("images_") :])))
    return [place for place in places if os.path.isdir(os.path.join(root, place))]


def _alike(folder, name):
    """The image in a folder that a name means: with another ending, those that may have alpha
    first, or, if it is the only one, in another case. None where there is none.
    """
    if not os.path.isdir(folder):
        return None
    bare = _bare(name)
    alike = _images(folder, os.stat(folder).st_mtime_ns).get(bare.lower(), [])
    exact = [one for one in alike if _bare(one) == bare]
    exact.sort(key=lambda one: (one != name, ENDINGS.index(os.path.splitext(one)[1].lower())))
    found = next(iter(exact or alike * (len(alike) == 1)), None)
    return found if found and os.path.isfile(os.path.join(folder, found)) else None


@lru_cache(maxsize=256)
def _images(folder, time):
    """{name without endings, in lower case: images in a folder}, last changed at that time."""
    found = {}
    for name in sorted(os.listdir(folder)):
        if name.lower().endswith(ENDINGS):
            found.setdefault(_bare(name).lower(), []).append(name)
    return found


def _bare(name):
    """The name of an image without its ending, which may stand there twice."""
    for _ in range(2):
        name = os.path.splitext(name)[0] if name.lower().endswith(ENDINGS) else name
    return name


# Masks --------------------------------------------------------------------------------------------


def find_mask(folder: Path, image: str, *, by_number: bool = False) -> str | None:
    """Path in a folder of masks of the mask of an image, a path in the same tree: with .png added,
    or its stem, maybe with _mask behind or mask_ before it, or, by_number, with its number as DTU
    has it. None where there is none.
    """
    above, name = posixpath.split(image)
    if not os.path.isdir(folder / above):
        return None
    masks = _masks(folder / above, os.stat(folder / above).st_mtime_ns)
    stem = PurePosixPath(name).stem
    found = masks.get(name) or masks.get(stem)
    if not found and by_number and stem.isdecimal():
        found = masks.get(int(stem))
    is_there = found and os.path.isfile(folder / above / found)
    return posixpath.join(above, found) if is_there else None


@lru_cache(maxsize=256)
def _masks(folder, time):
    """{what an image may be called, or its number: its mask} in a folder last changed then."""
    names = [name for names in _images(folder, time).values() for name in names]
    found = {os.path.splitext(name)[0]: name for name in names}
    for name in names:
        bare = _bare(name)
        for image in (bare, bare.removesuffix("_mask"), bare.removeprefix("mask_")):
            found.setdefault(image, name)
        if bare.isdecimal():
            found.setdefault(int(bare), name)
    return found


def find_masks(
    folder: Path, images: Sequence[str], places: Sequence[str] = MASK_FOLDERS
) -> dict[str, str] | None:
    """{image: its mask} of those that have one in the scene's folder of masks, which is called as
    one of the places; None without such a folder. A mask lies in the same tree, with or without the
    folder of images above it; where names of images are there once only, also at the top of its
    folder, or by its number. Raises UserError where no image has one.
    """
    place = folder_named(folder, places)
    if place is None:
        return None
    often = Counter(PurePosixPath(image).name for image in images)
    found = {}
    for image in images:
        mask = find_mask(folder / place, _in_tree(image)) or find_mask(folder / place, image)
        name = PurePosixPath(image).name
        if not mask and often[name] == 1:
            mask = find_mask(folder / place, name, by_number=True)
        if mask:
            found[image] = posixpath.normpath(f"{place}/{mask}")
    if not found:
        first = PurePosixPath(place) / f"{_in_tree(images[0])}.png"
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
    folder there, else images_N with the largest images.
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
