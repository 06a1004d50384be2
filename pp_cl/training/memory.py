"""The memory a training will take, summed over the tables of its stages before they allocate."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pp_cl.config import Config
from pp_cl.device.buffers import Table, grown, table_bytes
from pp_cl.device.device import Device
from pp_cl.device.rows import PIECE_BYTES, compact_table
from pp_cl.metrics.lpips import Lpips
from pp_cl.network.layers import gradient_of
from pp_cl.network.unet import UNet
from pp_cl.raster.blend import BLENDS, Blend
from pp_cl.raster.pairs import PairBuilder
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.raster.project import Projection
from pp_cl.raster.sh import sh_blocks
from pp_cl.render import NETWORK_MULTIPLE, Renderer, point_radius
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.scene.hull import DEPTH_MARGIN
from pp_cl.scene.load import reading
from pp_cl.scene.open import DEMO, mask_rule
from pp_cl.scene.photograph import Photograph
from pp_cl.scene.shrink import kept_bytes, shrink_factor
from pp_cl.training.crops import crop_side
from pp_cl.training.loss import Loss, lanes_of_loss
from pp_cl.training.mask import MaskLoss
from pp_cl.training.optimiser import Optimiser
from pp_cl.training.perceptual import PerceptualLoss
from pp_cl.training.point_state import PointState
from pp_cl.training.schedule import ema_start, prunings, refine_steps
from pp_cl.training.smooth import Smoother, chunk_points

MIB, GIB = 2**20, 2**30
# The share of the points that k prunings leave is about FIRST * k^-SLOWER on the initial grid, and
# on a refined one; measured on lego with the presets tiny, small and full.
FIRST_KEPT, FIRST_SLOWER = 0.745, 0.155
LATER_KEPT, LATER_SLOWER = 0.85, 0.068
# bytes on the host: of pruning per point (weights, looks, opacities, and which stay), of refining
# per point before it (the vertices of its eight in 64 bits, and their order)
PRUNING_BYTES, REFINING_BYTES = 24, 320

LEAST_RADIUS = 0.75  # pixels, as cl/raster/footprint.h has it

Tables = list[tuple[str, Table]]  # what the buffers of each table are for


class Moment(NamedTuple):
    """What is allocated at once at some time of a training. host: bytes of numpy arrays."""

    name: str
    points: int
    tables: Tables
    host: int

    @property
    def device(self) -> int:
        """Bytes of all buffers."""
        return tables_bytes(self.tables)


class Plan(NamedTuple):
    """The memory of a training. photographs: bytes of their images on the host; reading: beside
    those, while they are read.
    """

    moments: list[Moment]
    photographs: int
    reading: int

    @property
    def peak(self) -> Moment:
        """The moment with the most bytes on the device."""
        return max(self.moments, key=lambda moment: moment.device)

    @property
    def largest(self) -> tuple[str, int]:
        """(what it is for, bytes) of the largest buffer."""
        sizes = (
            (f"{what}: {name}", table_bytes({name: row}))
            for moment in self.moments
            for what, table in moment.tables
            for name, row in table.items()
        )
        return max(sizes, key=lambda size: size[1])

    def host(self, is_cpu: bool) -> int:
        """Most bytes that the host holds beside the program itself. is_cpu: of the device, whose
        buffers are the host's memory as well.
        """
        training = max(moment.host + is_cpu * moment.device for moment in self.moments)
        return self.photographs + max(training, self.reading)


@dataclass(frozen=True)
class Sketch:
    """What the memory of a training follows from.

    photographs: of the training views. points: at `step`. radius: of their footprints, pixels of
    the largest photograph as it is stored. layers: of the grid, on which points may lie.
    """

    config: Config
    net: UNet
    photographs: Sequence[Photograph]
    points: int
    radius: float
    layers: float
    step: int = 0

    @classmethod
    def unseen(cls, config: Config, net: UNet, photographs: Sequence[Photograph]) -> "Sketch":
        """Before the photographs are read and the hull is known: for a ball that fills the largest
        of them.
        """
        points = config.points.count
        camera = _largest([one.camera for one in photographs])
        diameter = math.sqrt(4 / math.pi * camera.width * camera.height)
        spacing = (math.pi / 6 * diameter**3 / points) ** (1 / 3)
        deep = DEPTH_MARGIN * math.sqrt(3) * diameter  # of the cube around it, as depth_range()
        radius = point_radius(config.raster, spacing, (0, deep))
        return cls(config, net, photographs, points, radius, points ** (1 / 3))

    def on_grid(
        self, grid: Grid, points: int, depth_range: tuple[float, float], step: int = 0
    ) -> "Sketch":
        """The same with points on a grid, seen from the middle of the depth range."""
        camera = _largest([one.camera for one in self.photographs])
        middle = sum(depth_range) / 2
        # footprints grow by 1 / (z^2 cos) nearer by and off the axis: the mean over a cube, to
        # second order
        growth = 1 + (grid.diagonal / middle) ** 2 / 9
        radius = point_radius(self.config.raster, grid.edge, depth_range)
        radius *= camera.fx / middle * math.sqrt(growth)
        return replace(self, points=points, radius=radius, layers=grid.dims[2], step=step)

    def with_points(self, points: int) -> "Sketch":
        """The same object with another number of points."""
        finer = (points / self.points) ** (1 / 3)
        return replace(
            self, points=points, radius=self.finer_radius(finer), layers=self.layers * finer
        )

    def finer_radius(self, times: float) -> float:
        """`radius` on a grid of so many times finer a spacing, which soft footprints follow."""
        return self.radius / (times if self.config.raster.footprint == "soft" else 1)

    def with_settings(self, **changes: int) -> "Sketch":
        """The same with other settings "downscale" and "crop"."""
        config = self.config
        scene = replace(config.scene, downscale=changes.get("downscale", config.scene.downscale))
        train = replace(config.train, crop=changes.get("crop", config.train.crop))
        return replace(self, config=replace(config, scene=scene, train=train))

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(width, height) of the photographs in their files."""
        return [(one.camera.width, one.camera.height) for one in self.photographs]

    @property
    def shrunk(self) -> int:
        """How many times the photographs are reduced while they are read."""
        scene = self.config.scene
        return 1 if scene.path == DEMO else shrink_factor(self.sizes, scene.downscale)

    @property
    def refinements(self) -> list[int]:
        """The steps of the refinements to come."""
        return [s for s in refine_steps(self.config.train) if s > self.step]

    @property
    def averages(self) -> float:
        """The step from which on averages are kept, infinite for never."""
        train = self.config.train
        return ema_start(train.iterations) if train.ema else math.inf


def memory_plan(sketch: Sketch) -> Plan:
    """The memory of the training. Pairs and points after prunings to come are estimates."""
    made = sketch.config.scene.path == DEMO
    _, beside = reading(sketch.photographs, mask_rule(sketch.config))
    photographs = kept_bytes(sketch.sizes, sketch.shrunk)
    return Plan(list(_moments(sketch)), photographs, 0 if made else beside)


def _moments(sketch: Sketch) -> Iterator[Moment]:
    """From the sketch's step on: each level of refinement, the refining, and the averages."""
    train, n = sketch.config.train, sketch.points
    steps = refine_steps(train)
    start = max((s for s in steps if s <= sketch.step), default=0)
    to_come = sketch.refinements
    averages = sketch.averages
    for level, end in enumerate([*to_come, train.iterations]):
        now, left = max(start, sketch.step), len(to_come) - level
        radius = sketch.finer_radius(2**level)
        args = {"left": left, "radius": radius, "start": now, "end": end}
        yield _moment(sketch, f"from step {now} on", n, ema=averages <= now, **args)
        before = _kept(train, start, now)
        if now < averages < end:
            kept = round(n * _kept(train, start, averages) / before)
            yield _moment(sketch, f"averages, from step {averages} on", kept, ema=True, **args)
        n = round(n * _kept(train, start, end) / before)
        if left:
            yield _refining(sketch, n, ema=averages <= end, **args)
            n, start = 8 * n, end


def _kept(train, start, end):
    """The share of the points of a level, which began at step `start`, that the prunings up to
    `end` leave, an estimate.
    """
    times = prunings(train, start, end)
    kept, slower = (LATER_KEPT, LATER_SLOWER) if start else (FIRST_KEPT, FIRST_SLOWER)
    return kept * times**-slower if times else 1.0


def _moment(sketch, name, n, *, left, radius, start, end, ema):
    """A level at its most points. left: refinements to come. radius: as Sketch has it."""
    train, blocks = sketch.config.train, sh_blocks(sketch.config.points.sh_degree)
    prunes = prunings(train, start, end) > 0
    row_bytes = max(64 * block.count for block in blocks)  # of the largest array of a point
    pruning = [("pruning (at most)", compact_table(n, row_bytes))] if prunes else []
    tables = [*_kept_tables(sketch, n, ema), *pruning, *_stages(sketch, n, left, radius)]
    every, last = train.checkpoint_every, min(end, train.iterations - 1)
    saves = start // every < last // every
    pieces = min(PIECE_BYTES, 64 * 8 * n) if saves else 0
    return Moment(name, n, tables, prunes * PRUNING_BYTES * n + 2 * pieces)


def _refining(sketch, n, *, left, radius, start, end, ema):
    """Old and new arrays of the points live together, one array after the other, beside the
    buffers of the stages for the old points.
    """
    blocks = sh_blocks(sketch.config.points.sh_degree)
    last = {
        "rows": ((8 * n,), np.uint32),
        "old": ((n, max(b.count for b in blocks), 16), np.float32),
    }
    tables = [
        *_kept_tables(sketch, 8 * n, ema),
        ("refining", last),
        *_stages(sketch, n, left, radius),
    ]
    return Moment(f"refining after step {end}", 8 * n, tables, REFINING_BYTES * n)


def _kept_tables(sketch, n, ema):
    """What stays from step to step. ema: with the averages."""
    blocks = sh_blocks(sketch.config.points.sh_degree)
    return [
        ("points", PointCloud.table(n, blocks)),
        ("training state of the points", PointState.table(n)),
        ("averages of the points", PointState.ema_table(n, blocks) if ema else {}),
        ("optimiser", Optimiser.table(sketch.net.parameters, ema)),
    ]


def _stages(sketch: Sketch, n: int, left: int, radius: float) -> Tables:
    """What the stages of a step and of a rendered preview take."""
    config, net = sketch.config, sketch.net
    train, downscale = config.train, config.scene.downscale
    camera = _largest([one.camera for one in sketch.photographs])
    whole, halved = camera.downscaled(downscale), camera.downscaled(downscale * 2**left)
    crop, full = _padded(_crop(halved, crop_side(train.crop, left))), _padded(_crop(whole, 0))
    width, height = _crop(halved, crop_side(train.crop, left))
    target = (height, width, 3)
    photograph = (camera.height // sketch.shrunk, camera.width // sketch.shrunk, 4)
    pairs = n * min(math.pi * max(LEAST_RADIUS, radius / downscale) ** 2, full[0] * full[1])
    return [
        ("smoothing (estimate)", _smoothing_table(sketch, n)),
        *_raster_tables(config.raster, n, full, pairs),
        (f"network at {crop[1]}x{crop[0]}", _network_table(net, crop, True)),
        (f"previews at {full[1]}x{full[0]}", _preview_table(net, full)),
        ("loss", Loss.table((*crop, 3), target, train.ssim_weight, lanes_of_loss(net.dev))),
        ("mask loss", MaskLoss.table(*crop) if train.mask_weight else {}),
        *(_perceptual_tables(net, target) if train.perceptual_weight else ()),
        (
            "photograph and target",
            {
                "image": (photograph, np.uint8),
                "target": (target, np.float32),
                "alpha": (target[:2], np.float32),
            },
        ),
    ]


def _largest(cameras: Sequence[Camera]) -> Camera:
    return max(cameras, key=lambda camera: (camera.width * camera.height, camera.fx))


def _crop(camera, side):
    """(width, height) of a crop; side 0: the whole image."""
    return tuple(min(side, size) if side else size for size in (camera.width, camera.height))


def _padded(size):
    """(height, width) in whole multiples of what the network needs."""
    return tuple(side + -side % NETWORK_MULTIPLE for side in size[::-1])


def _smoothing_table(sketch, n):
    """The Smoother's. Its chunk depends on the neighbours, which are not known yet: they are about
    a layer of the grid apart.
    """
    if sketch.config.train.sh_smoothing == 0:
        return {}
    layers = sketch.layers * (n / sketch.points) ** (1 / 3)
    return Smoother.table(n, chunk_points(n, round(n / layers)))


def _network_table(net, size, training):
    plan = net.memory_plan(*size, training)
    return {f"{i} {name}": (shape, np.float32) for i, (name, shape, _) in enumerate(plan)}


def _preview_table(net, size):
    """The buffers of whole images that are rendered, beside the network's parameters."""
    own = {name for p in net.parameters for name in (p, gradient_of(p))}
    return {
        f"{i} {name}": (shape, np.float32)
        for i, (name, shape, _) in enumerate(net.memory_plan(*size, False))
        if name not in own
    }


def _perceptual_tables(net, target):
    return [
        ("perceptual loss", PerceptualLoss.table(target)),
        ("network of LPIPS", Lpips.table(net.dev, net.policy, target[:2])),
    ]


def _raster_tables(settings, n, size, pairs):
    """The tables of the stages from projection to blending. pairs: an estimated number, because the
    true one is known only when a view has been projected.
    """
    pixels, room = size[0] * size[1], grown(0, round(pairs))
    blend = BLENDS[settings.blend]
    has_roles = settings.early_stop > 0 or settings.max_tracked > 0
    return [
        ("projection", Projection.table(n)),
        ("pairs (estimate)", PairBuilder.table(n, pixels, room)),
        (
            "blend weights (estimate)",
            blend.table(n, room, has_roles) | blend.own_table(pixels, room),
        ),
        ("blend", Blend.table(n)),
        ("features", Renderer.table(n, *size)),
    ]


def tables_bytes(tables: Tables) -> int:
    """Bytes of all buffers of the tables."""
    return sum(table_bytes(table) for _, table in tables)


def plan_lines(plan: Plan, dev: Device) -> list[str]:
    """The plan as text: device and host at their peaks in one line, then the device's buffers."""
    peak, (what, largest) = plan.peak, plan.largest
    rows = [(what, len(table), table_bytes(table)) for what, table in peak.tables if table]
    rows.append(("total", sum(number for _, number, _ in rows), peak.device))
    host = plan.host(dev.is_cpu)
    return [
        f"memory: {peak.device / MIB:.0f} of {dev.info['memory_bytes'] / MIB:.0f} MiB of {dev.name}"
        f" ({peak.name}, {peak.points} points), {host / MIB:.0f} MiB of the host"
        + (", the device's among them" if dev.is_cpu else ""),
        *(f"  {name:30s} {number:4d} buffers {size / MIB:9.1f} MiB" for name, number, size in rows),
        f"  largest buffer: {largest / MIB:.1f} MiB ({what}), of at most"
        f" {dev.info['max_allocation_bytes'] / MIB:.0f} at once",
        f"  photographs on the host: {plan.photographs / MIB:.0f} MiB",
    ]
