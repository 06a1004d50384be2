"""What is found in a scene's folder: the image that a name means, the mask of an image, folders of
images and of models, and what is there in place of a scene.
"""

import json
import os
import posixpath
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import TypeVar
from urllib.parse import unquote

from pp_cl.errors import Unusable, UserError, few_names, quoted
from pp_cl.files.atomic import sha256_of
from pp_cl.files.image import ENDINGS
from pp_cl.files.untrusted import read_json_text

# where programs put the images that a name may mean, in their order, beside images_2, images_4 ...
IMAGE_FOLDERS = ("images", "image", "input", "rgb", "dense/0/images", "dense/images")
MASK_FOLDERS = ("masks", "mask")
IGNORE_FOLDERS = ("ignore",)  # of masks that are white where an image says nothing
# of names that are no UTF-8: of Windows in Chinese, Japanese, Korean, Russian and western Europe
CODE_PAGES = ("gb18030", "cp932", "big5", "cp949", "cp1251", "cp1252", "cp437", "cp850", "cp866")
# folders in which models lie, and scenes in a folder without one
MOST_FOLDERS, MOST_DEPTH = 200, 6
MOST_JSON = 2**24  # bytes of a file that may be a transforms.json
# {what lies in the folder of a program or dataset that is not read: which of its exports is}
EXPORTS = {
    "*.xml": 'Metashape\'s, maybe; use its Export Cameras with the type "Colmap"',
    "*.csv": "RealityCapture's, maybe; use its export of registration for COLMAP",
    "cams/*_cam.txt": "BlendedMVS's; use its scenes as NeuS ships them, with cameras_sphere.npz",
    "keyframes/*cameras/*.json": "Polycam's; make a transforms.json by `ns-process-data polycam`",
    "metadata.json": "Record3D's, maybe; make a transforms.json by `ns-process-data record3d`",
    "camera/*.json": "of Nerfies, maybe, whose objects move; pp-cl needs one that is at rest",
    "*.zip": "a zip file; unpack it and give the folder in it",
}
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


# Images -------------------------------------------------------------------------------------------


def find_image(folder: Path, given: str, fail: Fail, kind: str = "image") -> str:
    """Path relative to the scene's folder of the image that a file there calls `given`: as it is
    written, or what is _alike() for the tails of the path, the longest first, beside the file and
    in IMAGE_FOLDERS, for the kind mask in MASK_FOLDERS. Nothing outside the folder is looked at.
    Raises fail(text) for what is no path, Unusable with its text where no image is.
    """
    root = os.path.realpath(folder)
    try:
        for form in dict.fromkeys((given, given.replace("\\", "/"))):
            path = os.path.join(root, form)
            if (inside := _inside(root, path)) and os.path.isfile(path):
                return inside
        stated = posixpath.normpath(given.replace("\\", "/"))
        parts = [part for part in stated.split("/") if part not in ("", ".", "..")]
        places = MASK_FOLDERS if kind == "mask" else _image_folders(root)
        for start in range(len(parts)):
            *above, name = parts[start:]
            for place in (".", *places):
                if kind == "mask" and place == "." and not above:
                    continue
                there = _below(root, posixpath.join(place, *above))
                if there and (found := _alike(os.path.join(root, there), name)):
                    return posixpath.normpath(posixpath.join(there, found))
    except (OSError, ValueError) as error:  # a name too long, a zero byte
        raise fail(f"{quoted(given, 80)} is not a usable path ({error})") from error
    text = f"no {kind} at {quoted(given, 80)} in {folder}; copy it there or remove the frame"
    if stated.startswith("../"):
        text = f"{quoted(given, 80)} leaves the scene's folder; copy the {kind} into {folder}"
    elif _bytes(given):
        text += "; or rename the images in ASCII, as the name is no UTF-8"
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


def natural(name: str) -> list[tuple[int, str]]:
    """The key by which names are sorted by the numbers in them: 10 after 9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def _inside(root, path):
    """A path relative to the root, of what a link leads to if that is inside; None outside."""
    for one in (os.path.realpath(path), os.path.normpath(path)):
        if os.path.commonpath([root, one]) == root:
            return os.path.relpath(one, root).replace(os.sep, "/")
    return None


def _below(root, path):
    """The folder in the root that a relative path means, in any of its _spellings(), or None."""
    found = root
    for part in path.split("/"):
        there = os.path.join(found, part)
        if not os.path.isdir(there):
            names = os.listdir(found) if os.path.isdir(found) else []
            alike = [one for one in names if _keys(one) & _keys(part)]
            there = os.path.join(found, alike[0]) if len(alike) == 1 else there
        found = there
    return os.path.relpath(found, root).replace(os.sep, "/") if os.path.isdir(found) else None


def _alike(folder, name):
    """The image in a folder that a name means: with another ending, those that may have alpha
    first, or, if it is the only one, in another case. None where there is none.
    """
    if not os.path.isdir(folder):
        return None
    bare, images = _bare(name.strip()), _images(folder, os.stat(folder).st_mtime_ns)
    alike = list(dict.fromkeys(one for key in _keys(bare) for one in images.get(key, [])))
    exact = [one for one in alike if _spellings(_bare(one)) & _spellings(bare)]
    exact.sort(key=lambda one: (one != name, ENDINGS.index(os.path.splitext(one)[1].lower())))
    found = next(iter(exact or alike * (len(alike) == 1)), None)
    return found if found and os.path.isfile(os.path.join(folder, found)) else None


@lru_cache(maxsize=256)
def _images(folder, time):
    """{each of the _keys() of a name without endings: images in a folder}, last changed then."""
    found = {}
    for name in sorted(os.listdir(folder)):
        for key in _keys(_bare(name)) if name.lower().endswith(ENDINGS) else ():
            found.setdefault(key, []).append(name)
    return found


def _bare(name):
    """The name of an image without its ending, which may stand there twice."""
    for _ in range(2):
        name = os.path.splitext(name)[0] if name.lower().endswith(ENDINGS) else name
    return name


def _spellings(name):
    """{a name as people see it}: in one form of Unicode, as an accent may be a letter of its own;
    by any of CODE_PAGES, if it is no UTF-8; as it is, and without the % of addresses.
    """
    found = {name}
    if content := _bytes(name):
        for page in CODE_PAGES:
            with suppress(UnicodeDecodeError):
                found.add(content.decode(page))
    elif "%" in name:
        found.add(unquote(name))
    return {unicodedata.normalize("NFC", one) for one in found}


def _keys(name):
    return {one.lower() for one in _spellings(name)}


def _bytes(name):
    """The bytes of a name that is no UTF-8, for which Python has surrogates; b"" of any other."""
    is_other = not name.isascii() and any("\udc80" <= letter <= "\udcff" for letter in name)
    return name.encode("utf-8", "surrogateescape") if is_other else b""


# Masks --------------------------------------------------------------------------------------------


def find_mask(folder: Path, image: str, *, by_number: bool = False) -> str | None:
    """Path in a folder of masks of the mask of an image, a path in the same tree: with .png added,
    or its stem, maybe with _mask behind or mask_ before it, or, by_number, with its number as DTU
    has it. None where there is none.
    """
    above, name = posixpath.split(image)
    if not os.path.isdir(folder) or (there := _below(folder, above or ".")) is None:
        return None
    masks = _masks(folder / there, os.stat(folder / there).st_mtime_ns)
    stem = PurePosixPath(name).stem
    wanted = (name, stem, *_keys(name), *_keys(stem))
    found = next((masks[key] for key in wanted if key in masks), None)
    if not found and by_number and stem.isdecimal():
        found = masks.get(int(stem))
    if not found or not os.path.isfile(folder / there / found):
        return None
    return posixpath.normpath(posixpath.join(there, found))


@lru_cache(maxsize=256)
def _masks(folder, time):
    """{what an image may be called, or its number: its mask} in a folder last changed then."""
    names = sorted({name for names in _images(folder, time).values() for name in names})
    found = {os.path.splitext(name)[0]: name for name in names}
    for name in names:
        bare = _bare(name)
        for image in (bare, bare.removesuffix("_mask"), bare.removeprefix("mask_")):
            found.setdefault(image, name)
        if bare.isdecimal():
            found.setdefault(int(bare), name)
    for image, name in list(found.items()):
        for key in _keys(image) if isinstance(image, str) else ():
            found.setdefault(key, name)
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


def _in_tree(image):
    """Its path in the folder of images."""
    for place in sorted(IMAGE_FOLDERS, key=len, reverse=True):
        if image.lower().startswith(f"{place}/"):
            return image[len(place) + 1 :]
    first, _, rest = image.partition("/")
    return rest if first.startswith("images_") and rest else image


# Folders ------------------------------------------------------------------------------------------


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


def folder_images(folder: Path, name: str) -> list[str]:
    """Sorted paths relative to the scene's folder of the images in its folder `name`. Raises
    UserError where there are none.
    """
    found = [
        file.name
        for file in sorted((folder / name).glob("*"))
        if file.suffix.lower() in ENDINGS and file.is_file() and not file.name.startswith(".")
    ]
    if not found:
        raise UserError(f"{folder / name}: no images in it; copy them there")
    return [f"{name}/{image}" for image in found]


def _image_folders(root):
    """IMAGE_FOLDERS that there are, in any case, and images_N, the largest images first."""
    entries = sorted(os.listdir(root))
    reduced = [entry for entry in entries if re.fullmatch(r"images_\d+", entry)]
    inside = {entry.lower(): entry for entry in reversed(entries)}
    usual = (inside.get(place, place) for place in IMAGE_FOLDERS)
    places = (*usual, *sorted(reduced, key=lambda entry: int(entry[len("images_") :])))
    return [place for place in places if os.path.isdir(os.path.join(root, place))]


def folder_of(folder: Path, names: Sequence[str]) -> Path | None:
    """The folder that has most images of these names, where none of IMAGE_FOLDERS is there."""
    if _image_folders(folder):
        return None
    of_masks = {*MASK_FOLDERS, *IGNORE_FOLDERS}
    places = [place for place in folders_below(folder) if place.name.lower() not in of_masks]
    most = max(places, key=lambda p: sum((p / name).is_file() for name in names), default=folder)
    return most if any((most / name).is_file() for name in names) else None


def folders_below(folder: Path) -> list[Path]:
    """Folders in a folder, in those and so on, the uppermost first; none that is hidden."""
    found: list[Path] = []
    level = [folder]
    for _ in range(MOST_DEPTH):
        inside: list[Path] = []
        for place in level:
            with suppress(OSError):
                inside += [p for p in sorted(place.iterdir()) if p.name[0] != "." and p.is_dir()]
        level = inside[: MOST_FOLDERS - len(found)]
        found += level
    return found


def nested(folder: Path, is_model: Callable[[Path], object]) -> list[Path]:
    """Folders of models that lie deep in a folder, but for those that have images of their own."""
    own = [place for place in folders_below(folder) if holds_images(place)]
    return [p for p in folders_below(folder) if is_model(p) and not {p, *p.parents} & {*own}]


def scene_near(folder: Path, reader_of: Callable[[Path], ModuleType | None]) -> str:
    """Words on the scene that is above a folder or in it; "" where none is."""
    for near in (*folder.absolute().parents[:2], *folders_below(folder)):
        if os.access(near, os.R_OK | os.X_OK) and (reader := reader_of(near)):
            return f"; {near} is one ({reader.FILES}); give that"
    return ""


def instead_of_scene(folder: Path) -> str:
    """What is in a folder without a scene, in words."""
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    for file in (path for path in inside if path.suffix.lower() == ".json"):
        with suppress(OSError, ValueError, RecursionError):
            found = json.loads(read_json_text(file, MOST_JSON, "utf-8-sig"))
            if isinstance(found, dict) and "frames" in found:
                return f": {quoted(file.name, 40)} has frames; is it a transforms.json? Rename it"
    for pattern, export in EXPORTS.items():
        for file in folder.glob(pattern):
            return f": {quoted(file.name, 40)} is {export}"
    names = few_names([quoted(path.name, 40) for path in inside]) or "nothing"
    return (
        f": {names}, but no file of cameras that is known, such as transforms.json or sparse/0;"
        " `pp-cl capture` makes one of photographs"
    )
