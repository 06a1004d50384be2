"""Makes masks of photographs with known cameras: from given masks, alpha, a uniform background or a
program of the user; otherwise by colour around the sparse points, with a vote of all views.
"""

import os
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_fill_holes
from skimage.measure import label
from skimage.segmentation import find_boundaries

from pp_cl import Progress, track
from pp_cl.engine import View, evenly, fitting_downscale
from pp_cl.errors import UserError, few_names, shown
from pp_cl.files import atomic_folder, contact_sheet, read_mask, read_rgba, write_png
from pp_cl.scene import (
    ImageFile,
    disagreements,
    named_mask,
    read_mask_of_size,
    shrink,
)
from pp_studio.capture import cut
from pp_studio.capture.packages import needed
from pp_studio.capture.uniform import uniform_mask

cv2 = needed("cv2")

OPAQUE = (".jpg", ".jpeg")  # files without alpha, which need not be read to find that out
GLANCED_SIDE = 640  # longer side, pixels, at which masks for finding features are made
UNIFORM = 0.9  # share of the photographs that must have a uniform background
SPOT = 0.9  # a hole of a mask is a spot on the object if other views see the object in this share
ON_MASK = 0.9  # share of the object's points that the mask of a uniform background must cover
CHECKED_SIDE = 200  # longer side, pixels, at which masks are compared
SHOWN_VIEWS, SHOWN_SIZE = 12, 320  # photographs of an image, and their longer side in pixels
OUTLINE = (255, 0, 160)  # a colour that few objects have
SECONDS = 600  # a program may take so long for a mask


def mask_file(scene: Path, name: str) -> Path:
    """The file to which write_masks() writes the mask of a photograph."""
    return scene / "masks" / f"{Path(name).stem}.png"


def write_masks(
    scene: Path,
    image_files: Sequence[ImageFile],
    box: np.ndarray,
    points: np.ndarray,
    seen: Sequence[np.ndarray],
    *,
    given: Path | None = None,
    sources: Mapping[str, str] | None = None,
    fitted: Callable[[str, np.ndarray], np.ndarray] = lambda _, mask: mask,
    command: str | None = None,
    turns: bool = False,
    grows: bool = False,
    grown: Callable[[np.ndarray], object] = lambda _: None,
) -> tuple[str, list[str], np.ndarray]:
    """Write the mask of each photograph to mask_file(), 8-bit gray, white on the object. Existing
    masks are kept and help to make the others. Returns one line on what was done, the names of
    photographs whose masks contradict the others, the worst first, and the box.

    scene: the folder to which the photographs' names are relative; their images have no distortion.
    box: (2, 3) around the object. points: (N, 3) in the scene's world. seen: for each photograph
    the indices (M,) of the points that it shows. given: a folder of masks of the distorted
    photographs, whose names may be those of the photographs' sources; sources: {name: source};
    fitted(name, mask): turns such a mask, (H, W) uint8, into the image's. command: runs a program
    that makes masks; {image} and {mask} stand for the files. turns: the object turns before a still
    background. grows: enlarge the box if it cuts off a part of the object; grown(box) is called
    then, before any mask that needs it is written. Raises UserError for missing or broken given
    masks, a program that fails, a box in which nothing is seen, and an object that has the colour
    of its uniform background.
    """
    words = None if command is None else program_words(command)
    (scene / "masks").mkdir(exist_ok=True)
    unmasked = _without_mask(scene, image_files)
    how = {"kept": len(image_files) - len(unmasked)}
    shown = [i for i, image_file in enumerate(image_files) if cut.place_of(image_file, box)]
    shown = shown or list(range(len(image_files)))  # window() then raises the error
    beside = {image_file.name for image_file in image_files} - {image_files[i].name for i in shown}
    mask_of = {} if given is None else _given(given, unmasked, sources or {})
    for image_file in track(unmasked, "masks", "image"):
        source, mask = _found(scene, image_file, mask_of, fitted, words)
        if mask is None and image_file.name in beside:  # such as at the beginning or end of a video
            source = "empty, as the object is outside"
            mask = np.zeros((image_file.camera.height, image_file.camera.width), np.uint8)
        if mask is not None:
            write_png(mask_file(scene, image_file.name), mask)
            how[source] = how.get(source, 0) + 1
    if _without_mask(scene, image_files):
        inside = cut.are_inside(points, box)
        in_view, seen = [image_files[i] for i in shown], [seen[i] for i in shown]
        reading = track(in_view, "reading images", "image")
        windows = [_window(scene, image_file, box) for image_file in reading]
        of_object = [points[indices[inside[indices]]] for indices in seen]
        how["before a uniform background"] = _uniform(scene, in_view, windows, box, of_object)
        if unmasked := _without_mask(scene, in_view):
            how["cut out"] = len(unmasked)
            for growth in range(1 + cut.GROWTHS):
                cut.cut_out_all(windows, box, points, seen, turns)
                larger = cut.grown_box(windows, box) if grows and growth < cut.GROWTHS else None
                if larger is None:
                    break
                box = larger
                grown(box)
                reading = track(in_view, "reading images", "image")
                windows = [_window(scene, image_file, box) for image_file in reading]
            of_name = dict(zip([image_file.name for image_file in in_view], windows, strict=True))
            for image_file in track(unmasked, "masks", "image"):
                mask = cut.whole_mask(
                    of_name[image_file.name], read_rgba(scene / image_file.name)[..., :3]
                )
                write_png(mask_file(scene, image_file.name), mask)
    counts = ", ".join(f"{count} {source}" for source, count in how.items() if count)
    checking = track(image_files, "checking masks", "image")
    views = [_reduced(scene, image_file, CHECKED_SIDE)[0] for image_file in checking]
    with Progress("comparing masks"):
        wrong = {
            disagreement.view.name: disagreement.share for disagreement in disagreements(views, box)
        }
    if wrong:
        shares = [f"{Path(name).name} ({share:.0%})" for name, share in wrong.items()]
        counts += f"; {len(wrong)} contradict the others: {few_names(shares)}"
    return counts, list(wrong), box


def _without_mask(scene, image_files):
    return [
        image_file for image_file in image_files if not mask_file(scene, image_file.name).is_file()
    ]


def _given(folder, image_files, sources):
    """{name of a photograph: its mask in a folder}; raises UserError if it is another's, too."""
    mask_of, source_of = {}, {}
    for image_file in image_files:
        name = Path(image_file.name).name
        source = sources.get(name, name)
        mask = mask_of[image_file.name] = named_mask(folder, source, name)
        if mask in source_of:
            raise UserError(
                f"{mask}: the mask of {source_of[mask]} and of {source}; put masks in subfolders"
                " like those of the photographs"
            )
        source_of[mask] = source
    return mask_of


def _found(scene, image_file, given, fitted, words):
    """(its source, (H, W) uint8 mask or None) of a photograph, without looking at the others."""
    file, size = scene / image_file.name, (image_file.camera.width, image_file.camera.height)
    if image_file.name in given:
        mask = read_mask_of_size(given[image_file.name], size)
        return "given", fitted(image_file.name, mask)
    if words is not None:
        return "by the program", _of_program(words, file, size[::-1])
    if not image_file.name.lower().endswith(OPAQUE):
        alpha = read_rgba(file)[..., 3]
        if (alpha < 255).any():
            return "of their alpha", alpha
    return "none", None


def _of_program(words, image, shape):
    """The mask that a program makes of a photograph. Raises UserError."""
    who = f"--mask-command: {shown(words[0])}: {image.name}"
    with tempfile.TemporaryDirectory(prefix="pp-cl-") as folder:
        mask = Path(folder) / "mask.png"
        for key, path in (("{image}", image.resolve()), ("{mask}", mask)):
            words = [word.replace(key, str(path)) for word in words]
        try:
            done = subprocess.run(words, capture_output=True, timeout=SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UserError(f"{who}: {error}; fix the command") from None
        if done.returncode or not mask.is_file():
            lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no word of it"]
            what = f"status {done.returncode}" if done.returncode else "no mask written"
            raise UserError(f"{who}: {what}: {shown(lines[-1])}; fix the command")
        pixels = read_mask(mask)
    if pixels.shape != shape:
        raise UserError(f"{who}: its mask has another size than the photograph; fix the command")
    return pixels


def program_words(command: str) -> list[str]:
    """The words of --mask-command. Raises UserError unless they name a program, {image}, {mask}."""
    lexer = shlex.shlex(command, posix=True)
    lexer.whitespace_split, lexer.commenters = True, ""
    if os.name == "nt":  # on Windows, backslashes separate folders, and names hold apostrophes
        lexer.escape, lexer.quotes = "", '"'
    try:
        words = list(lexer)
    except ValueError as error:
        raise UserError(f"--mask-command {command}: {error}; fix the quotes") from None
    if not words or "{image}" not in command or "{mask}" not in command:
        raise UserError(f"--mask-command {command}: write it as 'PROGRAM {{image}} {{mask}}'")
    return words


def _written_mask(scene, image_file):
    """(H, W) uint8 mask of a photograph, from the scene, where a user may have written it."""
    file = mask_file(scene, image_file.name)
    return read_mask_of_size(file, (image_file.camera.width, image_file.camera.height))


def _window(scene, image_file, box):
    """The Window of a photograph, with its mask if that exists."""
    window = cut.window(read_rgba(scene / image_file.name)[..., :3], image_file, box)
    if mask_file(scene, image_file.name).is_file():
        window.mask = window.reduced(_written_mask(scene, image_file)) > 127
    return window


def _uniform(scene, image_files, windows, box, points):
    """If nearly all photographs have a uniform background, write their masks; returns how many."""
    unmasked = [i for i, window in enumerate(windows) if window.mask is None]
    held = {}  # for each mask, whether it covers the object's points that its view shows
    with_holes = len(windows) * cut.FORGIVEN >= 1  # since one view votes against a hole in a spot
    masks = {}
    for i in track(unmasked, "looking for a uniform background", "image"):
        mask = uniform_mask(windows[i].image, windows[i].name, with_holes)
        if mask is not None:
            mask, (_, rows, columns) = mask > 127, windows[i].inside(points[i])
            # features of thin parts also lie in the gaps between these
            held[i] = (
                binary_fill_holes(mask)[rows, columns] if len(rows) else np.array([mask.any()])
            )
            masks |= {i: mask} if held[i].mean() >= ON_MASK else {}
    if len(masks) < UNIFORM * len(unmasked):
        if (
            len(held) >= UNIFORM * len(unmasked)
            and np.concatenate([*held.values()]).mean() < ON_MASK
        ):
            raise UserError(
                f"{scene}: what is behind the object has one colour, and so have parts of"
                " it; take the photographs before another colour, or give masks with --masks"
            )
        return 0
    for i, mask in masks.items():
        windows[i].mask = mask
    spots = _spots(windows, masks, box) if with_holes and masks else {}
    for i in track(masks, "masks", "image", len(masks)):
        name, window = image_files[i].name, windows[i]
        mask, window.mask = uniform_mask(read_rgba(scene / name), name, with_holes), None
        if mask is None:
            continue
        if i in spots:
            x0, y0, x1, y1 = window.place
            closed = cv2.resize(spots[i].astype(np.uint8), (x1 - x0, y1 - y0)) > 0
            mask[y0:y1, x0:x1][closed] = 255
        write_png(mask_file(scene, name), mask)
        window.mask = window.reduced(mask) > 127
    return sum(windows[i].mask is not None for i in masks)


def _spots(windows, numbers, box):
    """{index of a window: (H, W) bool, holes of its mask in which other views see the object}."""
    masked = [window for window in windows if window.mask is not None]
    hull, rejections, _, voxel_size = cut.forgiving_hull(masked, box)
    spots = {}
    for i in numbers:
        window = windows[i]
        regions = label(binary_fill_holes(window.mask) & ~window.mask, connectivity=1)
        # neighbouring views, too, reject all places behind a gap
        shown, rows, columns = window.inside(hull)
        others = rejections[shown] - ~window.mask[rows, columns]
        held = cut.silhouette(
            window, hull[shown[others == 0]], cut.gap_of(window, hull, voxel_size)
        )
        is_spot = np.bincount(regions.ravel(), held.ravel()) > SPOT * np.bincount(regions.ravel())
        is_spot[0] = False
        spots[i] = cut.dilated(is_spot[regions], 1)
    return spots


def write_inside(frames: Path, names: Sequence[str], folder: Path, is_uniform: bool) -> None:
    """Write NAME.png, 8-bit gray, for each photograph into the new folder, white on the object: by
    alpha, which may hide a wall, or by the uniform background, if nearly all photographs have one;
    otherwise all white. If no photograph has either, write nothing.
    """
    with atomic_folder(folder) as unfinished:
        names_left, may_have = list(names), [n for n in names if not n.lower().endswith(OPAQUE)]
        for name in track(may_have, "alpha", "image"):
            alpha = read_rgba(frames / name)[..., 3]
            if (alpha < 255).any():
                write_png(unfinished / f"{name}.png", np.where(alpha > 127, np.uint8(255), 0))
                names_left.remove(name)
        if len(names_left) == len(names) and not is_uniform:
            return
        for name in track(names_left, "backgrounds", "image"):
            image = read_rgba(frames / name)
            image = shrink(image, fitting_downscale(image.shape[:2], GLANCED_SIDE))
            mask = uniform_mask(image, name) if is_uniform else None
            mask = np.full(image.shape[:2], 255, np.uint8) if mask is None else mask
            write_png(unfinished / f"{name}.png", mask)


def outline_sheet(
    scene: Path, image_files: Sequence[ImageFile], first: Sequence[str] = ()
) -> np.ndarray:
    """uint8 (H, W, 3) contact sheet of up to 12 photographs with the outlines of their masks.
    first: names of the photographs that come first; the others are spread evenly.
    """
    wrong = [image_file for image_file in image_files if image_file.name in first][:SHOWN_VIEWS]
    others = [image_file for image_file in image_files if image_file.name not in first]
    chosen = wrong + evenly(others, SHOWN_VIEWS - len(wrong))
    images = []
    for image_file in chosen:
        view, factor = _reduced(scene, image_file, SHOWN_SIZE)
        image, held = (
            shrink(read_rgba(scene / image_file.name), factor)[..., :3],
            view.image[..., 3] > 127,
        )
        image[~held] //= 2
        image[find_boundaries(held, mode="thick")] = OUTLINE
        images.append(image)
    return contact_sheet(images, [Path(image_file.name).name for image_file in chosen])


def _reduced(scene, image_file, side):
    """(a View of a photograph's mask, reduced to a longer side of about `side`, the factor)."""
    mask = _written_mask(scene, image_file)
    factor = fitting_downscale(mask.shape, side)
    image = shrink(np.dstack([mask] * 4), factor)
    return View(image_file.name, image_file.camera.downscaled(factor), image), factor
