"""Makes what a new training starts from: its network, visual hull and refinements."""

import math
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pp_cl.checkpoint import opened_run
from pp_cl.config import RANDOM, load_config, text_of
from pp_cl.engine.device.device import Device
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.training.schedule import refinements
from pp_cl.engine.views import View
from pp_cl.errors import UserError, few_names
from pp_cl.files.run_folder import MASKS_SHEET, RunFolder
from pp_cl.scene.hull import (
    TOLERANCE,
    Agreement,
    Hull,
    build_grid,
    contradicting,
    depth_range,
    spacing_pixels,
)
from pp_cl.scene.listing import DEMO, scene_box
from pp_cl.scene.outline import outline_sheet
from pp_cl.scene.verdict import judged
from pp_cl.session.memory import MemoryPlan
from pp_cl.session.plan import NEVER, UNSET, Plan
from pp_cl.settings import Config, NetworkConfig

# train.refine_at for 0, 1 and 2 refinements; after the last, points are FINEST to COARSEST pixels
# apart
REFINE_AT = (NEVER, (0.35, 1.0), (0.33, 0.67))
FINEST, COARSEST = 1.25, 1.5
LEAST_SIDE = 48  # least side in pixels of the reduced images on which a refining training begins
# written by `make network`: {"net.NAME": as Network.parameters, float16}
DEMO_NETWORK = Path(__file__).with_name("demo.npz")


def begin_network(dev: Device, config: Config) -> UNet:
    """Make the network that network.start names; the demo's only for another scene and if it has
    this shape, else a random one. Raises UserError for a run whose network has another shape.
    """
    net = UNet.of_settings(dev, config.network, seed=config.train.seed)
    settings = config.network
    if settings.start == DEMO:
        if config.scene.path != DEMO and not _unlike(settings, NetworkConfig()):
            with np.load(DEMO_NETWORK) as stored:
                for name, parameter in net.parameters.items():
                    dev.write(parameter, stored[f"net.{name}"].astype(np.float32))
    elif settings.start != RANDOM:
        folder = RunFolder(settings.start)
        other = load_config(folder.config)
        for key, ours, theirs in _unlike(settings, other.network):
            raise UserError(
                f"network.start: {folder} has {key}={theirs}, this training {ours}; set {key}"
                " alike, or begin with another network"
            )
        with opened_run(folder, other) as run:
            for name, parameter in net.parameters.items():
                dev.write(parameter, run.array(f"net.{name}"))
    return net


def _unlike(ours, theirs):
    """[(key, our value, their value)] of the settings that make two networks differ in shape."""
    pairs = [(n, getattr(ours, n), getattr(theirs, n)) for n in ("widths", "blocks")]
    return [(f"network.{n}", text_of(a), text_of(b)) for n, a, b in pairs if a != b]


def first_hull(
    dev: Device, config: Config, agreement: Agreement
) -> tuple[Hull, tuple[float, float]]:
    """Return (the hull that a training starts from, its train.refine_at). If refine_at is
    automatic, the refinements bring points FINEST to COARSEST pixels of the images close.
    """
    points, shares, box = config.points.count, config.train.refine_at, scene_box(config)
    views, _, forgiven = agreement
    hull = build_grid(dev, views, points, box, forgiven)
    if not _is_open(config):
        return hull, shares
    cameras = [view.camera for view in views]
    spacing = spacing_pixels(hull.grid, cameras)
    smallest = min(min(camera.width, camera.height) for camera in cameras)
    possible = [n for n in range(1, len(REFINE_AT)) if smallest >= LEAST_SIDE << n]
    times = sum(spacing > COARSEST * 2 ** (n - 1) for n in possible)
    first = min(max(spacing, 2**times * FINEST), 2**times * COARSEST)
    if times and first != spacing:
        hull = build_grid(dev, views, round(points * (spacing / first) ** 3), box, forgiven)
    return hull, REFINE_AT[times] if shares == UNSET else shares


def _is_open(config):
    """Whether refinements decide how far apart points are at first; also in a run's further
    members, which have the refinements of the first.
    """
    return config.train.refine_at == UNSET or "train.refine_at" in config.automatic


class FittingHull(NamedTuple):
    """The hull that a training starts from. agreement: of the views' masks. depth_range: (near,
    far) of the hull. plan: the training's. given_up: lines on what lack of memory prevents, or "".
    """

    agreement: Agreement
    hull: Hull
    depth_range: tuple[float, float]
    plan: Plan
    given_up: str


def fitting_hull(
    dev: Device, config: Config, views: list[View], memory_plan: MemoryPlan
) -> FittingHull:
    """Return the first_hull() that fits into memory. If memory is too small, supersampling is given
    up; if that does not suffice and refine_at is automatic, points are only as close as memory
    allows, with as many refinements. Raises UserError as MemoryPlan.check_points() does, and if
    raster.radius is automatic but footprints are not soft.
    """
    given_up: list[str] = []
    if config.raster.radius == 0 and config.raster.footprint != "soft":
        raise UserError(
            f"raster.radius: is automatic, which raster.footprint={config.raster.footprint}"
            " cannot be; give it in world units at a depth range of 4 (0.0015 in the paper)"
        )
    agreement, _ = judged(dev, config, views)
    views, _, forgiven = agreement
    hull, refine_at = first_hull(dev, config, agreement)
    plan = Plan.of(config, hull, agreement, refine_at)
    to_come = len(refinements(plan.train(config.train)))
    cameras = [view.camera for view in views]
    last = math.inf  # points of the previous try
    while True:
        memory_plan.follow(plan.settings(config))
        of_hull = hull.grid, len(hull.ids), depth_range(views, hull)
        fault = memory_plan.fault_of(*of_hull)
        if fault and plan.supersampled > 0:
            plan = plan.with_one_sample()
            memory_plan.follow(plan.settings(config))
            given_up.append(f"features: of one sample a pixel in the end ({fault[0]})")
            fault = memory_plan.fault_of(*of_hull)
        can_be_fewer = _is_open(config) and len(hull.ids) < last
        fewer = memory_plan.coarser_points(*of_hull) if fault and can_be_fewer else 0
        if not (fault and fewer):
            memory_plan.check_points(*of_hull)
            return FittingHull(agreement, hull, of_hull[-1], plan, "\n".join(given_up))
        if last == math.inf:
            spacing = spacing_pixels(hull.grid, cameras) / 2**to_come
            given_up.append(
                f"points: as close as memory allows; {len(hull.ids)} at first, {spacing:.2f} pixels"
                f" apart in the end, would be too many ({fault[0]})"
            )
        last = len(hull.ids)
        hull = build_grid(dev, views, max(1, int(fewer / TOLERANCE)), scene_box(config), forgiven)
        plan = plan.for_grid(config.train, hull.grid, views)


def sheet_of_masks(
    dev: Device, views: list[View], hull: Hull, agreement: Agreement
) -> np.ndarray | None:
    """Warn of masks that disagree with the others; return an image of them, None if all agree."""
    wrong, left_out = contradicting(views, hull, agreement), agreement.left_out
    rejecting = {
        disagreement.view.name: disagreement.share
        for disagreement in wrong
        if disagreement.view.name not in left_out
    }
    for what, shares in (
        ("lie beside what the other views agree on, and are left out of the training", left_out),
        ("reject what the other views agree on", rejecting),
    ):
        if shares:
            worst = few_names([f"{name} ({share:.0%} of it)" for name, share in shares.items()])
            warnings.warn(
                f"masks {what}: {worst}; see {MASKS_SHEET} in the run's folder", stacklevel=2
            )
    return outline_sheet(dev, views, hull, wrong) if wrong or left_out else None
