"""Searches a scene's folder for the image that a name means, the mask of an image, and folders of
images and models; describes the contents of a folder that holds no scene.
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
from pp_cl.files.untrusted import read_json_text, read_regular, refusal

# folders in which programs put images, in the order of the search; images_2, images_4 ... follow
IMAGE_FOLDERS = ("images", "image", "input", "rgb", "dense/0/images", "dense/images")
MASK_FOLDERS = ("masks", "mask")
IGNORE_FOLDERS = ("ignore",)  # folders of masks that are white on the pixels to ignore
# encodings of names that are not UTF-8, from Chinese, Japanese, Korean, Russian and western Windows
CODE_PAGES = ("gb18030", "cp932", "big5", "cp949", "cp1251", "cp1252", "cp437", "cp850", "cp866")
# how many folders, and how deep, are searched for models, and for scenes inside other folders
MOST_FOLDERS, MOST_DEPTH = 200, 6
MOST_JSON = 2**24  # bytes of a file that may be a transforms.json
MOST_LIST = 2**24  # bytes of a list of images
# {file of a program or dataset whose format pp-cl cannot read: which export it can read}
EXPORTS = {
    "*.xml": 'perhaps Metashape\'s; use its Export Cameras with the type "Colmap"',
    "*.csv": "perhaps RealityCapture's; export its registration for COLMAP",
    "*.sfm": "Meshroom's; write COLMAP's files with `aliceVision_exportColmap`",
    "sfm.abc": "Meshroom's; write COLMAP's files with `aliceVision_exportColmap`",
    "sfm_data*": "OpenMVG's; write COLMAP's files with `openMVG_main_openMVG2Colmap`",
    "reconstruction.json": "perhaps OpenSfM's; write COLMAP's files with `opensfm export_colmap`",
    "*.nvm": "VisualSFM's, which is not read; `pp-cl capture` finds the cameras of photographs",
    "bundle*.out": "Bundler's, which is not read; `pp-cl capture` finds the cameras of photographs",
    "cams/*_cam.txt": "BlendedMVS's; use its scenes as NeuS ships them, with cameras_sphere.npz",
    "keyframes/*cameras/*.json": "Polycam's; make a transforms.json with `ns-process-data polycam`",
    "metadata.json": "perhaps Record3D's; make a transforms.json with `ns-process-data record3d`",
    "camera/*.json": "perhaps from Nerfies, whose objects move; pp-cl needs an object at rest",
    "*.zip": "a zip file; unpack it and give the folder in it",
}
Item = TypeVar("Item")
Result = TypeVar("Result")
Fail = Callable[[str], UserError]  # makes an error that names the file and the key
LeftOut = list[tuple[str, UserError]]  # names of the views that cannot be used, with the reason


def usable(
    items: Iterable[Item],
    read: Callable[[Item], Result],
    name: Callable[[Item], str],
    left_out: LeftOut,
) -> Iterator[Result]:
    """Yield read(item) for each item; if it raises UserError, append (name(item), the error) to
    left_out instead.
    """
    for item in items:
        try:
            yield read(item)
        except UserError as error:
            left_out.append((name(item), error))


# Images -------------------------------------------------------------------------------------------


def find_image(folder: Path, given: str, fail: Fail, kind: str = "image") -> str:
    """Path, relative to the scene's folder, of the image that a file there calls `given`: exactly
    that path, or else an image _alike() to the path without its first folders, as few as possible,
    in the scene's folder or IMAGE_FOLDERS (for masks: MASK_FOLDERS). It never looks outside the
    folder. Raises fail(text) if `given` is not a path, and Unusable if there is no such image.
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
                if there and (image := _alike(os.path.join(root, there), name)):
                    return posixpath.normpath(posixpath.join(there, image))
    except (OSError, ValueError) as error:  # a name too long, a zero byte
        raise fail(f"{quoted(given, 80)} is not a usable path ({error})") from error
    text = f"no {kind} at {quoted(given, 80)} in {folder}; copy it there or remove the frame"
    if stated.startswith("../"):
        text = f"{quoted(given, 80)} leaves the scene's folder; copy the {kind} into {folder}"
    elif _bytes(given):
        text += "; or give the images ASCII names, as the name is not UTF-8"
    raise Unusable(fail(text), f"no {kind}")


def find_file(folder: Path, name: str) -> Path:
    """The file in a folder that a name in any of its _spellings() means: the same name, or the only
    one alike; the folder's `name` if there is none.
    """
    file = folder / name
    if file.exists() or not folder.is_dir():
        return file
    alike = [other for other in sorted(os.listdir(folder)) if _keys(other) & _keys(name)]
    return folder / alike[0] if len(alike) == 1 else file


def listed_in(file: Path, images: Sequence[str]) -> set[str]:
    """The images that the lines of a text file mean, by their paths in the folder of images or by
    their last parts, with or without an ending. Raises UserError for a file that is not text, is
    too long, or names none.
    """
    try:
        lines = read_regular(file, MOST_LIST, "utf-8-sig").split("\n")
    except (OSError, ValueError) as error:
        raise refusal(file, error, "text") from None
    paths = (_in_tree(line.strip().replace("\\", "/")) for line in lines)
    wanted = {key for path in paths for key in _keys(_bare(path))}
    bare = {image: _bare(image) for image in images}
    named = {i for i in images if (_keys(bare[i]) | _keys(posixpath.basename(bare[i]))) & wanted}
    if not named:
        raise UserError(f"{file}: names no image of the scene; correct or remove it")
    return named


def pictures_of(files: Sequence[Path]) -> list[object]:
    """A key for each file that only copies of the same picture share: its path, or its digest if
    another file has the same size.
    """
    readable = [os.path.isfile(file) and os.access(file, os.R_OK) for file in files]
    sizes = [os.path.getsize(f) if ok else -1 for f, ok in zip(files, readable, strict=True)]
    often = Counter(sizes)
    return [
        sha256_of(file).digest() if size >= 0 and often[size] > 1 else file
        for file, size in zip(files, sizes, strict=True)
    ]


def numbered(names: Sequence[str], count: int) -> dict[int, str] | None:
    """{index: name}: the indices of sorted names in a list of `count` names, some of which are
    missing. The number in a name, less the lowest number, is its index; None if the numbers do not
    tell.
    """
    if len(names) == count:
        return dict(enumerate(names))
    matches = [re.search(r"(\d+)\D*$", PurePosixPath(name).stem) for name in names]
    numbers = [int(match[1]) if match else -1 for match in matches]
    low, high = min(numbers), max(numbers)
    is_whole = low > -1 and len(set(numbers)) == len(numbers) and high - low == count - 1
    return {n - low: name for n, name in zip(numbers, names, strict=True)} if is_whole else None


def natural(name: str) -> list[tuple[int, str]]:
    """A sort key that compares the numbers in names as numbers, so that 10 follows 9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def _inside(root, path):
    """The path relative to the root, with links resolved if the target is inside; None if the path
    is outside.
    """
    for candidate in (os.path.realpath(path), os.path.normpath(path)):
        if os.path.commonpath([root, candidate]) == root:
            return os.path.relpath(candidate, root).replace(os.sep, "/")
    return None


def _below(root, path):
    """The folder, relative to the root, that a path in any of its _spellings() means, or None."""
    reached = root
    for part in path.split("/"):
        there = os.path.join(reached, part)
        if not os.path.isdir(there):
            names = os.listdir(reached) if os.path.isdir(reached) else []
            alike = [name for name in names if _keys(name) & _keys(part)]
            there = os.path.join(reached, alike[0]) if len(alike) == 1 else there
        reached = there
    return os.path.relpath(reached, root).replace(os.sep, "/") if os.path.isdir(reached) else None


def _alike(folder, name):
    """The image in a folder that a name means: the same name with any ending, preferring formats
    that may have alpha, or the only image whose name differs in case. None if there is none.
    """
    if not os.path.isdir(folder):
        return None
    bare, images = _bare(name.strip()), _images(folder, os.stat(folder).st_mtime_ns)
    alike = list(dict.fromkeys(image for key in _keys(bare) for image in images.get(key, [])))
    exact = [image for image in alike if _spellings(_bare(image)) & _spellings(bare)]
    exact.sort(key=lambda image: (image != name, ENDINGS.index(os.path.splitext(image)[1].lower())))
    chosen = next(iter(exact or alike * (len(alike) == 1)), None)
    return chosen if chosen and os.path.isfile(os.path.join(folder, chosen)) else None


@lru_cache(maxsize=256)
def _images(folder, time):
    """{key: images in a folder}, by all _keys() of their names without endings. time: when the
    folder was last changed, so that the cache is not stale.
    """
    by_key = {}
    for name in sorted(os.listdir(folder)):
        for key in _keys(_bare(name)) if name.lower().endswith(ENDINGS) else ():
            by_key.setdefault(key, []).append(name)
    return by_key


def _bare(name):
    """The name of an image without its ending, which may be doubled."""
    for _ in range(2):
        name = os.path.splitext(name)[0] if name.lower().endswith(ENDINGS) else name
    return name


def _spellings(name):
    """The forms of a name that look the same to people: in NFC, since an accent may be a character
    of its own; decoded with each of CODE_PAGES if it is not UTF-8; without %-escapes.
    """
    spellings = {name}
    if content := _bytes(name):
        for page in CODE_PAGES:
            with suppress(UnicodeDecodeError):
                spellings.add(content.decode(page))
    elif "%" in name:
        spellings.add(unquote(name))
    return {unicodedata.normalize("NFC", spelling) for spelling in spellings}


def _keys(name):
    return {spelling.lower() for spelling in _spellings(name)}


def _bytes(name):
    """The bytes of a name that is not UTF-8, which Python keeps as surrogates; b"" if it is."""
    is_other = not name.isascii() and any("\udc80" <= letter <= "\udcff" for letter in name)
    return name.encode("utf-8", "surrogateescape") if is_other else b""


# Masks --------------------------------------------------------------------------------------------


def find_mask(folder: Path, image: str, *, by_number: bool = False) -> str | None:
    """Path of an image's mask in a folder of masks with the same subfolders as the images. The mask
    has the image's name with .png added, its stem, or its stem with _mask after it or mask_ before
    it, or (by_number) its number, as in DTU. None if there is no mask.
    """
    above, name = posixpath.split(image)
    if not os.path.isdir(folder) or (there := _below(folder, above or ".")) is None:
        return None
    masks = _masks(folder / there, os.stat(folder / there).st_mtime_ns)
    stem = PurePosixPath(name).stem
    wanted = (name, stem, *_keys(name), *_keys(stem))
    mask = next((masks[key] for key in wanted if key in masks), None)
    if not mask and by_number and stem.isdecimal():
        mask = masks.get(int(stem))
    if not mask or not os.path.isfile(folder / there / mask):
        return None
    return posixpath.normpath(posixpath.join(there, mask))


@lru_cache(maxsize=256)
def _masks(folder, time):
    """{possible name or number of an image: its mask} in a folder. time: as for _images()."""
    names = sorted({name for names in _images(folder, time).values() for name in names})
    by_image = {os.path.splitext(name)[0]: name for name in names}
    for name in names:
        bare = _bare(name)
        for image in (bare, bare.removesuffix("_mask"), bare.removeprefix("mask_")):
            by_image.setdefault(image, name)
        if bare.isdecimal():
            by_image.setdefault(int(bare), name)
    for image, name in list(by_image.items()):
        for key in _keys(image) if isinstance(image, str) else ():
            by_image.setdefault(key, name)
    return by_image


def find_masks(
    folder: Path, images: Sequence[str], places: Sequence[str] = MASK_FOLDERS
) -> dict[str, str] | None:
    """{image: its mask} for the images that have a mask in the scene's folder of masks, the first
    of the places that exists; None without such a folder. Masks lie in the images' subfolders, with
    or without the folder of images above them; if the image's name is unique, also at the top, or
    by number. Raises UserError if no image has a mask.
    """
    place = folder_named(folder, places)
    if place is None:
        return None
    often = Counter(PurePosixPath(image).name for image in images)
    mask_of = {}
    for image in images:
        mask = find_mask(folder / place, _in_tree(image)) or find_mask(folder / place, image)
        name = PurePosixPath(image).name
        if not mask and often[name] == 1:
            mask = find_mask(folder / place, name, by_number=True)
        if mask:
            mask_of[image] = posixpath.normpath(f"{place}/{mask}")
    if not mask_of:
        first = PurePosixPath(place) / f"{_in_tree(images[0])}.png"
        usual = first.with_suffix("").with_suffix(".png")
        raise UserError(
            f"{folder / place}: no mask of any image in it, such as {first} or {usual}; add masks,"
            " or remove the folder"
        )
    return mask_of


def _in_tree(image):
    """The path of an image in the folder of images."""
    for place in sorted(IMAGE_FOLDERS, key=len, reverse=True):
        if image.lower().startswith(f"{place}/"):
            return image[len(place) + 1 :]
    first, _, rest = image.partition("/")
    return rest if first.startswith("images_") and rest else image


# Folders ------------------------------------------------------------------------------------------


def folder_named(folder: Path, names: Sequence[str]) -> str | None:
    """The subfolder with the first of the names that exists, in any case, or None."""
    inside = {entry.lower(): entry for entry in sorted(os.listdir(folder), reverse=True)}
    candidates = (inside.get(name, name) for name in names)
    return next((name for name in candidates if (folder / name).is_dir()), None)


def holds_images(folder: Path) -> bool:
    """Whether a folder contains images or a folder for images."""
    inside = (entry.lower().endswith(ENDINGS) for entry in os.listdir(folder))
    return bool(_image_folders(folder)) or any(inside)


def image_folder(folder: Path, names: Sequence[str] = IMAGE_FOLDERS) -> str:
    """The folder of images, for a format that does not name them: the first of the names that
    exists, or else the images_N with the largest images.
    """
    reduced = [place for place in _image_folders(folder) if place.lower() not in IMAGE_FOLDERS]
    return folder_named(folder, names) or next(iter(reduced), names[0])


def folder_images(folder: Path, name: str) -> list[str]:
    """Sorted paths, relative to the scene's folder, of the images in its folder `name`. Raises
    UserError if there are none.
    """
    names = [
        file.name
        for file in sorted((folder / name).glob("*"))
        if file.suffix.lower() in ENDINGS and file.is_file() and not file.name.startswith(".")
    ]
    if not names:
        raise UserError(f"{folder / name}: no images in it; copy them there")
    return [f"{name}/{image}" for image in names]


def _image_folders(root):
    """The IMAGE_FOLDERS that exist, in any case, then images_N, the largest images first."""
    entries = sorted(os.listdir(root))
    reduced = [entry for entry in entries if re.fullmatch(r"images_\d+", entry)]
    inside = {entry.lower(): entry for entry in reversed(entries)}
    usual = (inside.get(place, place) for place in IMAGE_FOLDERS)
    places = (*usual, *sorted(reduced, key=lambda entry: int(entry[len("images_") :])))
    return [place for place in places if os.path.isdir(os.path.join(root, place))]


def folder_of(folder: Path, names: Sequence[str]) -> Path | None:
    """The folder with the most images of these names, if none of IMAGE_FOLDERS exists."""
    if _image_folders(folder):
        return None
    of_masks = {*MASK_FOLDERS, *IGNORE_FOLDERS}
    places = [place for place in folders_below(folder) if place.name.lower() not in of_masks]
    most = max(places, key=lambda p: sum((p / name).is_file() for name in names), default=folder)
    return most if any((most / name).is_file() for name in names) else None


def folders_below(folder: Path) -> list[Path]:
    """All folders below a folder but hidden ones, the uppermost first."""
    folders: list[Path] = []
    level = [folder]
    for _ in range(MOST_DEPTH):
        inside: list[Path] = []
        for place in level:
            with suppress(OSError):
                inside += [p for p in sorted(place.iterdir()) if p.name[0] != "." and p.is_dir()]
        level = inside[: MOST_FOLDERS - len(folders)]
        folders += level
    return folders


def nested(folder: Path, is_model: Callable[[Path], object]) -> list[Path]:
    """Folders of models deep in a folder, except in those that have images of their own."""
    own = [place for place in folders_below(folder) if holds_images(place)]
    return [p for p in folders_below(folder) if is_model(p) and not {p, *p.parents} & {*own}]


def scene_near(folder: Path, reader_of: Callable[[Path], ModuleType | None]) -> str:
    """Half a sentence on a scene above or below a folder; "" if there is none."""
    for near in (*folder.absolute().parents[:2], *folders_below(folder)):
        if os.access(near, os.R_OK | os.X_OK) and (reader := reader_of(near)):
            return f"; {near} is one ({reader.FILES}); give that instead"
    return ""


def instead_of_scene(folder: Path) -> str:
    """Half a sentence on the contents of a folder that holds no scene."""
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    for file in (path for path in inside if path.suffix.lower() == ".json"):
        with suppress(OSError, ValueError, RecursionError):
            data = json.loads(read_json_text(file, MOST_JSON, "utf-8-sig"))
            if isinstance(data, dict) and "frames" in data:
                return f": {quoted(file.name, 40)} has frames; is it a transforms.json? Rename it"
    for pattern, export in EXPORTS.items():
        for file in folder.glob(pattern):
            return f": {quoted(file.name, 40)} is {export}"
    names = few_names([quoted(path.name, 40) for path in inside]) or "nothing"
    return (
        f": {names}, but no known file of cameras, such as transforms.json or sparse/0;"
        " `pp-cl capture` makes a scene from photographs"
    )
