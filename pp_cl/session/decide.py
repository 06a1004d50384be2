"""All that a training decides itself: by its minutes, its hull and memory. Each decision is a
setting's value and its reason in words, which Config.decisions keeps and `pp-cl info RUN` prints.
"""

import copy
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import psutil

from pp_cl.config import Given, assign, field_of, run_config
from pp_cl.drivers import open_device
from pp_cl.engine.camera import divided
from pp_cl.engine.device.device import Device
from pp_cl.engine.render import is_supersampled
from pp_cl.engine.training.schedule import EMA_FROM, refinements, supersampling_at
from pp_cl.engine.views import MIN_SIDE, View
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.hull import (
    CELL_CAP,
    TOLERANCE,
    Agreement,
    Hull,
    build_grid,
    depth_range,
    spacing_pixels,
)
from pp_cl.scene.listing import scene_box, scene_frames
from pp_cl.scene.verdict import judged
from pp_cl.session.memory import Memory, Place
from pp_cl.settings import Config
from pp_cl.speeds import speed_of

NEVER = (1.0, 1.0)  # train.refine_at if the grid is never refined
# train.refine_at for 0, 1 and 2 refinements; after the last, points are FINEST to COARSEST pixels
# apart
REFINE_AT = (NEVER, (0.35, 1.0), (0.33, 0.67))
FINEST, COARSEST = 1.25, 1.5
LEAST_SIDE = 48  # least side in pixels of the reduced images on which a refining training begins
# Bounds of an automatic raster.radius, in point spacings; within them it is one pixel. A smaller
# radius is no better if points lie farther apart.
LEAST_RADIUS, MOST_RADIUS = 0.85, 1.15
# A refinement makes a step 2 to 3 times as long. It pays if this many steps would fit without it
# into the time that is left, for the first one and for the second: in 250 steps of `small`, lego
# reaches 27.4 dB with its refinement and 29.8 without, in 800 steps 31.5 and 32.3, in 1,160 steps
# 33.1 and 32.7; in 3,000 steps of `full` 34.4 with two and 35.0 with one, in 7,500 as much.
PAYS_FROM = 1500, 8500


# Without --preset and --iterations: minutes of a training, and the longer side of its images by
# them, on two cores with AVX-512: docs/recipe.md, "Minutes and sizes of images".
MINUTES = 10.0
SIDES = {
    0.0: ("tiny", 200),
    1.0: ("small", 400),
    2.0: ("small", 500),
    9.0: ("small", 667),
    20.0: ("small", 800),
    40.0: ("full", 1000),
}
PACE = 650.0  # speed_of() such a machine
# In fewer minutes on such a machine, there is no second refinement; points begin closer instead.
TWICE = 30.0
RESAMPLED = 1.15  # images are resampled if they are so many times as large; it blurs them a little
LOOKED, FULL = 0.5, 0.9  # seconds in which the processor's use is measured; share of it


class Start(NamedTuple):
    """What a training starts from. config: with all decisions. agreement: of the views' masks.
    depth_range: (near, far) of the hull.
    """

    config: Config
    agreement: Agreement
    hull: Hull
    depth_range: tuple[float, float]


def config_of(
    folder: RunFolder, scene: str, preset: str | None, given: Iterable[Given], device: str | None
) -> Config:
    """run_config(), but a new training that names neither preset nor iterations takes the images'
    size, and with it the preset, by its minutes and the device. device: as in open_device().
    """
    given = list(given)
    keys = {key for key, _, _ in given}
    if preset or folder.config.exists() or "train.iterations" in keys:
        return run_config(folder, scene, preset, given)
    train = run_config(folder, scene, None, given).train
    minutes = train.minutes or MINUTES
    name, downscale, why = sized(scene, minutes / train.members, device)
    config = run_config(folder, scene, name, given)
    if not train.minutes:
        told = f"minutes: {minutes:g}, as neither --minutes nor --iterations is given"
        config = decided(config, "train.minutes", minutes, told)
    if "scene.downscale" not in keys:
        config = decided(config, "scene.downscale", downscale, why)
    return config


def sized(scene: str, minutes: float, device: str | None) -> tuple[str, float, str]:
    """(preset, scene.downscale, reason) for a scene in these minutes of training on a device."""
    dev = open_device(device)
    share = free_share() if dev.is_cpu else 1.0
    worth = share * _worth(dev, minutes)
    name, side = next(SIDES[least] for least in sorted(SIDES, reverse=True) if worth >= least)
    cameras = [image_file.camera for image_file in scene_frames(scene)]
    longest = max(max(camera.width, camera.height) for camera in cameras)
    shortest = min(min(camera.width, camera.height) for camera in cameras)
    whole, ratio = divided(max(1.0, min(longest / side, shortest / MIN_SIDE)))
    downscale = whole if ratio < RESAMPLED else whole * ratio
    others = f", of which other programs take {1 - share:.0%}" if share < 1 else ""
    why = f"size: images reduced {downscale:.3g} times, for {minutes:.3g} minutes on this device"
    return name, downscale, f"{why}{others} (--downscale sets another)"


def _worth(dev, minutes):
    """The minutes that a device's minutes are on two cores with AVX-512."""
    return minutes * (speed_of(dev.device) or PACE) / PACE


def free_share() -> float:
    """The share of the processor left by running programs, which are expected to run on."""
    cores, busy = os.cpu_count() or 1, psutil.cpu_percent(interval=LOOKED) / 100
    load = cores * busy
    if busy > FULL:  # programs that wait count, too; else the mean has some that ended since
        load = max(load, psutil.getloadavg()[0])
    return cores / (cores + load)


def decided(config: Config, key: str, value: Any, why: str) -> Config:
    """A copy of the settings in which a decision gives section.key a value."""
    config = copy.deepcopy(config)
    assign(config, key, value, "decision")
    config.decisions[key] = why
    return config


def as_decided(config: Config, other: Config) -> Config:
    """A copy of the settings with the decisions of another training."""
    for key, why in other.decisions.items():
        section, _, name = key.partition(".")
        config = decided(config, key, getattr(getattr(other, section), name), why)
    return config


def decide(dev: Device, config: Config, views: list[View], memory: Memory) -> Start:
    """Decide how a training on these views starts: how far apart points are, how often they are
    refined, their radius and opacities. If memory is too small for it, pixels have one sample; if
    that does not suffice and refine_at is automatic, points are only as close as memory allows.
    Raises UserError as Memory.check() does, and if raster.radius is automatic but footprints are
    not soft.
    """
    if config.raster.radius == 0 and config.raster.footprint != "soft":
        raise UserError(
            f"raster.radius: is automatic, which raster.footprint={config.raster.footprint}"
            " cannot be; give it in world units at a depth range of 4 (0.0015 in the paper)"
        )
    agreement, _ = judged(dev, config, views)
    views, _, forgiven = agreement
    is_open = _is_open(config, "train.refine_at")
    hull, refine_at = first_hull(dev, config, agreement)
    times = sum(0 < share < 1 for share in refine_at)
    if is_open:
        why = "refinements: none, as they are close enough, or images too small to be halved"
        if times:
            at = " and ".join(f"{share:.0%}" for share in refine_at[:times])
            why = f"refinements: at {at} of the training, as fog clears sooner on smaller images"
        config = decided(config, "train.refine_at", refine_at, why)
    if _is_open(config, "train.view_opacity"):
        why = "opacity: the same from all sides, as masks contradict each other"
        why = why if forgiven else "opacity: by direction, as masks agree"
        value = "off" if forgiven else "on"
        config = decided(config, "train.view_opacity", value, why)
    if not is_supersampled(config.raster):
        why = f"samples: one a pixel, as raster.blend={config.raster.blend} allows for no more"
        config = decided(config, "train.supersampled", 0.0, why)
    elif share := config.train.supersampled:
        why = f"samples: four a pixel in the last {share:.0%} of the training, for sharper edges;"
        why += " before that one, as four take 1.3 times as long"
        config = decided(config, "train.supersampled", share, why)
    place, limit = Place(hull.grid, len(hull.ids), depth_range(views, hull)), ""
    config = _with_radius(config, place.grid, views)
    if config.train.supersampled and (fault := memory.fault(config, place)):
        config = _with_one_sample(config, fault)
    while is_open and (fault := memory.fault(config, place)):
        fewer = int(memory.most_points(config, place) / TOLERANCE)
        coarser = fewer and build_grid(dev, views, fewer, scene_box(config), forgiven)
        if not coarser or len(coarser.ids) >= place.points:
            break
        spacing = spacing_pixels(place.grid, [view.camera for view in views]) / 2**times
        limit = limit or (
            f": as close as memory allows; {place.points} at first, {spacing:.2f} pixels apart in"
            f" the end, would be too many ({fault[0]})"
        )
        hull, place = coarser, Place(coarser.grid, len(coarser.ids), depth_range(views, coarser))
        config = _with_radius(config, place.grid, views)
    memory.check(config, place)
    why = limit or ", wherever the masks have the object"
    if hull.capped:
        why += f"; only {place.points} of the {config.points.count} asked for, since a finer grid"
        why += f" would have more than {CELL_CAP} cells"
    spacing = spacing_pixels(place.grid, [view.camera for view in views])
    finer = "".join(f", later {spacing / 2**n:.2f}" for n in range(1, times + 1))
    why = f"points: {place.points} at first, {spacing:.2f} pixels apart{finer}{why}"
    config = decided(config, "points.count", config.points.count, why)
    return Start(config, agreement, hull, place.depth_range)


def first_hull(
    dev: Device, config: Config, agreement: Agreement
) -> tuple[Hull, tuple[float, float]]:
    """Return (the hull that a training starts from, its train.refine_at). If refine_at is
    automatic, the refinements bring points FINEST to COARSEST pixels of the images close.
    """
    points, shares, box = config.points.count, config.train.refine_at, scene_box(config)
    views, _, forgiven = agreement
    hull = build_grid(dev, views, points, box, forgiven)
    if not _is_open(config, "train.refine_at"):
        return hull, shares
    cameras = [view.camera for view in views]
    spacing = spacing_pixels(hull.grid, cameras)
    smallest = min(min(camera.width, camera.height) for camera in cameras)
    most, train = len(REFINE_AT) - 1, config.train
    if train.minutes and _worth(dev, train.minutes / train.members) < TWICE:
        most = 1
    possible = [n for n in range(1, most + 1) if smallest >= LEAST_SIDE << n]
    times = sum(spacing > COARSEST * 2 ** (n - 1) for n in possible)
    first = min(max(spacing, 2**times * FINEST), 2**times * COARSEST)
    if times and first != spacing:
        hull = build_grid(dev, views, round(points * (spacing / first) ** 3), box, forgiven)
    return hull, shares if "train.refine_at" in config.decisions else REFINE_AT[times]


def _is_open(config, key):
    """Whether a setting is automatic, or was when a training's first member decided on it."""
    section, _, name = key.partition(".")
    value = getattr(getattr(config, section), name)
    return key in config.decisions or value == field_of(key).default


def _with_radius(config, grid, views, progress=0.0):
    """The settings with a radius, if it is automatic, of one pixel of the images, within bounds,
    after the refinements that are still to come.
    """
    if not _is_open(config, "raster.radius"):
        return config
    to_come = sum(progress < at for at in refinements(config.train))
    spacing = spacing_pixels(grid, [view.camera for view in views]) / 2**to_come
    radius = round(min(max(1 / spacing, LEAST_RADIUS), MOST_RADIUS), 3)
    why = f"radius: {radius:g} spacings of points, near one pixel of the images"
    return decided(config, "raster.radius", radius, why)


def _with_one_sample(config, fault):
    why = f"samples: one a pixel, for lack of memory ({fault[0]})"
    return decided(config, "train.supersampled", 0.0, why)


def followed(config: Config, begun: int) -> Config:
    """The settings that the engine follows: an extended training, `begun` > 0, is not refined."""
    return replace(config, train=replace(config.train, refine_at=NEVER)) if begun else config


def least(config: Config, progress: float = 0.0) -> Config:
    """The settings without what a training may give up after a progress for lack of memory."""
    train, has_samples = config.train, supersampling_at(progress, config.train) == 2
    supersampled, ema = train.supersampled * has_samples, train.ema and progress >= EMA_FROM
    train = replace(train, refine_at=NEVER, supersampled=supersampled, ema=ema)
    return replace(config, train=train)


def decide_growth(
    config: Config,
    memory: Memory,
    place: Place,
    views: Sequence[View],
    begun: int,
    *,
    progress: tuple[float, float],
    steps_left: float | None,
) -> tuple[Config, list[str]]:
    """(the settings with which a training goes on, what is given up for lack of memory), before it
    takes more memory and time. begun: as in followed(). progress: before and after the last step.
    steps_left: that the minutes allow for, if they take as long as the last ones; None without
    minutes.
    """
    before, after = progress
    shares = refinements(followed(config, begun).train)
    made, due = sum(at <= before for at in shares), [at for at in shares if before < at <= after]

    def fault():
        at = due[-1] if due else after
        return memory.fault(followed(config, begun), place.refined(len(due)), at)

    def unrefined(why):
        shares = tuple(1.0 if at in due else at for at in config.train.refine_at)
        unrefined = decided(config, "train.refine_at", shares, f"refinements: {made}; {why}")
        return _with_radius(unrefined, place.grid, views, after)

    least, given_up = PAYS_FROM[min(made, 1)], []
    is_open = _is_open(config, "train.refine_at")
    if due and is_open and steps_left is not None and steps_left < least:
        config = unrefined(f"another pays from {least} steps on, {steps_left:.0f} were left")
        due = []
    has_samples = config.train.supersampled > 0 and supersampling_at(before, config.train) == 1
    if has_samples and (found := fault()):
        config = _with_one_sample(config, found)
        given_up.append("features are of one sample a pixel")
    if due and (found := fault()):
        config, due = unrefined(f"no more for lack of memory ({found[0]})"), []
        given_up.append("points are not refined")
    if config.train.ema and before < EMA_FROM and (found := fault()):
        why = f"averages: none, for lack of memory ({found[0]})"
        config = decided(config, "train.ema", False, why)
        given_up.append("parameters are not averaged")
    return config, given_up
