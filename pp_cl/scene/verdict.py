"""Judges whether a scene's cameras are right, by the share of its masks beside their hull, and
finds the reading in which they would be right.
"""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.views import View, evenly, fitting_downscale
from pp_cl.errors import UserError, few_names
from pp_cl.scene.conventions import EXIF, MEANING, SQUARE, STATED, Stated, read_as, readings
from pp_cl.scene.edits import EDITS, read_edits
from pp_cl.scene.gaze import ahead, meeting, upward
from pp_cl.scene.hull import (
    MOST_LEFT_OUT,
    Agreement,
    Beside,
    agreement_of,
    shares_beside,
    suspects,
)
from pp_cl.scene.image_file import ImageFile, shrink
from pp_cl.scene.listing import DEMO, find_reader, list_split, scene_box, scene_splits
from pp_cl.settings import Config

# The mean share of a mask beside the hull is 0 to 0.016 in sound scenes, and 0.13 and more with
# wrong cameras (docs/scenes.md). With a quarter of the masks forgiven it is 0.016 and more with
# wrong cameras, and 0 if half of the masks lack a part.
MOST_BESIDE, PERSISTING = 0.06, 0.005
NOWHERE = Beside(1.0, 1.0)  # for masks that leave no hull
INEXACT, EXACT = MOST_BESIDE / 3, MOST_BESIDE / 30
# A reading is right if its share is at most MEETS, and TIMES_LESS times smaller than as stated.
MEETS, TIMES_LESS = 0.01, 4.0
TRIED_VIEWS, TRIED_SIZE, TRIED_POINTS = 32, 160, 20_000  # a coarse hull takes a quarter of a second
LEAST_CAMERAS = 4
OBLONG = 1.1  # ratio of a pixel's sides that real cameras seldom exceed


class WrongCameras(UserError):
    """A scene's cameras cannot be right. The message names the reading in which they would be."""


def judged(dev: Device, config: Config, views: Sequence[View]) -> tuple[Agreement, float]:
    """(agreeing() of a scene's training views, the share of their masks beside the hull). Raises
    WrongCameras if cameras cannot be right, judged by masks or, without masks, by where they look,
    and where agreement_of() finds no hull.
    """
    path, box, fault = config.scene.path, scene_box(config), None
    axes = STATED if path == DEMO else read_edits(Path(path)).axes
    has_masks, kept = any(view.has_mask for view in views), list(views)
    try:
        agreement, beside = agreement_of(dev, views, box)
        kept = agreement.views
    except UserError as error:  # no place is in all masks
        fault, beside = error, NOWHERE
    cameras = [view.file_camera for view in kept]
    reading = None if has_masks or axes else other_axes(cameras, find_reader(path).STATES)
    if reading:
        raise WrongCameras(_told(path, "its cameras do not look at one place", reading, cameras))
    may_judge = not has_masks and box is None and axes != STATED
    if may_judge and (names := _suspected(kept)):
        raise WrongCameras(f"{path}: {names}: their cameras contradict the others; correct them")
    whole = beside
    if box is not None and beside.strictly > MOST_BESIDE:  # the box may cut the object off
        with suppress(UserError):
            _, whole = agreement_of(dev, views)
    what = f"{whole.strictly:.0%} of its masks' area lies beside their hull"
    what = "its masks leave no point" if whole == NOWHERE else what
    if axes is None and whole.strictly > INEXACT:
        reading = fitting_reading(dev, path, views)
        message = _told(path, what, reading, cameras) if reading else ""
        if reading and whole.strictly > MOST_BESIDE:
            raise WrongCameras(message)
        if whole.strictly <= MOST_BESIDE:
            message = message or f"{path}: {what}: cameras or masks are inexact"
            warnings.warn(message, stacklevel=2)
    names = _suspected(kept) if fault or whole.strictly > MOST_BESIDE else ""
    first = f", first those of {names}" if names else ""
    is_wrong = whole.strictly > MOST_BESIDE and whole.forgiving > PERSISTING
    if is_wrong and axes != STATED and not fault:
        raise WrongCameras(
            f"{path}: {what}, so cameras or masks are wrong, in a way that pp-cl does not know:"
            f" check the order of poses and images, focal lengths and masks{first}; if all are"
            f' right, write {{"axes": "{STATED}"}} into {Path(path) / EDITS}'
        )
    if fault:
        raise WrongCameras(f"{fault}{first}")
    if (oblong := _oblong(cameras)) and not (has_masks and beside.strictly < EXACT):
        warnings.warn(f"{path}: {oblong}; are both focal lengths right?", stacklevel=2)
    if by := upward([view.camera for view in agreement.views])[1]:
        message = f"upper edges of the images contradict each other; up is taken from {by}"
        warnings.warn(f"{path}: {message}", stacklevel=2)
    return agreement, beside.strictly


def _suspected(views):
    """The names of suspects()."""
    return few_names([views[i].name for i in suspects(views)])


def _told(path, what, reading, cameras):
    """The message on cameras that would be right in a reading."""
    words, file = reading.split(), Path(path) / EDITS
    would = " and ".join(MEANING[word] for word in words)
    if words[0] == SQUARE:
        what += f", and {_oblong(cameras)}"
    mend = ", or correct fl_y" if words[0] == SQUARE else ""
    mend = ", or turn the pictures" if {"upside-down", EXIF} & {*words} else mend
    mend = ", or mirror the pictures back" if "mirrored" in words else mend
    return (
        f"{path}: {what}; its cameras would be right as {would}. If they are of the"
        f' kind "{reading}", write {{"axes": "{reading}"}} into {file}{mend}; if they are right as'
        f' stated, write {{"axes": "{STATED}"}}'
    )


def _oblong(cameras):
    """Half a sentence on pixels that are not square; "" if they are."""
    wide = float(np.median([camera.fy / camera.fx for camera in cameras]))
    sides = "wide as high" if wide > 1 else "high as wide"
    ratio = max(wide, 1 / wide)
    return f"pixels would be {ratio:.2f} times as {sides}" if ratio > OBLONG else ""


def other_axes(cameras: Sequence[Camera], stated: Stated) -> str | None:
    """The reading of matrices and their axes in which cameras best look at one place from around
    it. None if they already do so as stated, or in no reading.
    """
    if len(cameras) < LEAST_CAMERAS or meeting(cameras):
        return None
    files = [ImageFile("", camera) for camera in cameras]
    other = "opengl" if stated[1] == "opencv" else "opencv"
    inverse = "world-to-camera" if stated[0] == "camera-to-world" else "camera-to-world"
    scores = {
        reading: meeting([image_file.camera for image_file in read_as(files, reading, stated)])
        for reading in (other, inverse, f"{other} {inverse}")
    }
    best = max(scores, key=lambda reading: scores[reading])
    return best if scores[best] else None


def fitting_reading(dev: Device, path: str, views: Sequence[View]) -> str | None:
    """The reading in which a scene's cameras agree with its training views' masks, or None."""
    stated, small = find_reader(path).STATES, _small(evenly(views, TRIED_VIEWS))
    files: list[ImageFile] = []
    for split in scene_splits(path):
        with suppress(UserError):  # a training needs no other split than its own
            files += list_split(path, split, edited=False).image_files
    forgiven = int(MOST_LEFT_OUT * len(small))
    as_stated = _beside(dev, small, forgiven)
    if as_stated < PERSISTING:
        return None  # some masks are wrong
    best, least = None, min(MEETS, as_stated / TIMES_LESS)
    for reading in readings(stated):
        if best and " " in reading:
            break  # a simpler reading is good enough
        cameras = {
            image_file.name: image_file.camera
            for image_file in read_as(files, reading, stated, Path(path))
        }
        tried = [replace(view, stored_camera=_reduced(cameras[view.name], view)) for view in small]
        # a reading that does not apply to these files leaves the cameras as stated
        if ahead([view.camera for view in tried]) and not _alike(tried, small):
            share = _beside(dev, tried, forgiven)
            best, least = (reading, share) if share < least else (best, least)
    return best


def _reduced(camera, view):
    """A camera of a view's file, for its stored image."""
    across, down = (
        view.stored_camera.fx / view.file_camera.fx,
        view.stored_camera.fy / view.file_camera.fy,
    )
    focal = {"fx": across * camera.fx, "fy": down * camera.fy}
    size = {"width": view.stored_camera.width, "height": view.stored_camera.height}
    return replace(camera, cx=across * camera.cx, cy=down * camera.cy, **focal, **size)


def _small(views):
    """The views with reduced images, which carve quickly."""
    small = []
    for view in views:
        stored = view.stored_camera
        k = fitting_downscale((stored.width, stored.height), TRIED_SIZE)
        camera, ignored = stored.downscaled(k), view.ignored
        if ignored is not None:
            ignored = ignored[: k * camera.height : k, : k * camera.width : k]
        image = shrink(view.image, k)
        changed = {"image": image, "ignored": ignored, "downscale": 1}
        small.append(
            replace(view, stored_camera=camera, unshrunk_camera=view.file_camera, **changed)
        )
    return small


def _alike(views, others):
    cameras = ([view.camera.packed((0, 1)) for view in group] for group in (views, others))
    return np.array_equal(*cameras)


def _beside(dev, views, forgiven):
    """The mean share of the views' masks beside their hull, 1 if there is no hull."""
    try:
        return float(shares_beside(dev, views, None, forgiven, TRIED_POINTS).mean())
    except UserError:
        return 1.0
