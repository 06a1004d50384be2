"""The memory plan: sums the buffer tables of all stages of a training before anything is allocated,
and compares the sum with the memory of device and host.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pp_cl.config import Config
from pp_cl.device.buffers import PIECE_BYTES, Table, compact_table, grown, table_bytes
from pp_cl.device.device import Device
from pp_cl.device.host import available_bytes, resident_bytes
from pp_cl.errors import UserError
from pp_cl.model import Model
from pp_cl.network.unet import PARAMETERS, UNet
from pp_cl.raster.blend import blend_backward_table
from pp_cl.raster.points import PointCloud, sh_blocks
from pp_cl.render import NETWORK_MULTIPLE, Renderer, point_radius
from pp_cl.scene.grid import MOST_VERTICES, Grid
from pp_cl.scene.load import DEMO, mask_rule, reading
from pp_cl.scene.views import Photograph, kept_bytes, shrink_factor
from pp_cl.training.exposure import Exposure
from pp_cl.training.loss import Loss, MaskLoss, lanes_of_loss
from pp_cl.training.optim import Optimiser
from pp_cl.training.schedule import crop_side, ema_start, prunings, refine_steps
from pp_cl.training.smooth import Smoother
from pp_cl.training.state import PointState

MIB, GIB = 2**20, 2**30
# The share of the points that pruning leaves by the next refinement or the last step, about: 0.45
# to 0.73 on lego with the presets tiny, small and full.
KEPT_BY_PRUNING = 0.6
# bytes on the host: of pruning per point (weights, looks, opacities, and which stay), of refining
# per point before it (the vertices of its eight in 64 bits, and their order); checkpoints are
# written in pieces
PRUNING_BYTES, REFINING_BYTES = 24, 320
LEAST_RADIUS = 0.75  # pixels, as cl/raster/footprint.h has it
# How many times its share of an image's pixels a crop sees of the points: up to 4 times on lego,
# where an image shows the object on a third of its pixels.
CROP_SHARE = 4
# The share of the points that an image shows, with room for more: 0.25 of a ball of fog, 0.46 of
# lego's surface; all where no hits are dropped.
SHOWN = 0.4
# What a driver's compiler takes of the host until all kernels of a training are built, measured;
# of a platform that is not listed the most.
DRIVER_BYTES = {"Portable Computing Language": 80 * MIB, "Intel(R) OpenCL": 620 * MIB}


class MemoryPhase(NamedTuple):
    """What is allocated at the same time in one phase of a training.

    tables: {what the buffers are for: their table}. host: bytes of numpy arrays.
    """

    name: str
    points: int
    tables: dict[str, Table]
    host: int

    @property
    def device(self) -> int:
        """Bytes of all buffers."""
        return _bytes(self.tables)


class Plan(NamedTuple):
    """The memory of a training. photographs: bytes of their images on the host; reading: beside
    those, while they are read.
    """

    phases: list[MemoryPhase]
    photographs: int
    reading: int

    @property
    def peak(self) -> MemoryPhase:
        """The phase with the most bytes on the device."""
        return max(self.phases, key=lambda phase: phase.device)

    @property
    def largest(self) -> tuple[str, int]:
        """(what it is for, bytes) of the largest buffer."""
        sizes = (
            (f"{what}: {name}", table_bytes({name: row}))
            for phase in self.phases
            for what, table in phase.tables.items()
            for name, row in table.items()
        )
        return max(sizes, key=lambda size: size[1])

    def host(self, is_cpu: bool) -> int:
        """Most bytes that the host holds beside the program itself. is_cpu: of the device, whose
        buffers are the host's memory as well.
        """
        training = max(phase.host + is_cpu * phase.device for phase in self.phases)
        return self.photographs + max(training, self.reading)


class Room:
    """Checks that a training fits the available memory; made before the training allocates
    anything.

    photographs: of the training views. plan: that of the last check.
    """

    def __init__(self, config: Config, net: UNet, photographs: Sequence[Photograph]):
        self.dev = net.dev
        self.plan: Plan
        self._config, self._net, self._photographs = config, net, photographs
        cameras = [one.camera for one in photographs]
        self._largest = max(cameras, key=lambda camera: (camera.width * camera.height, camera.fx))
        driver = DRIVER_BYTES.get(self.dev.info["platform"], max(DRIVER_BYTES.values()))
        held = resident_bytes() - (self.dev.bytes if self.dev.is_cpu else 0)
        self._program = held + driver

    @property
    def host_bytes(self) -> int:
        """What this process takes of the host at its peak, by the plan."""
        return self._program + self.plan.host(self.dev.is_cpu)

    def check_unseen(self) -> None:
        """Raise UserError as check_points() does if even the least memory that the training can
        take does not fit; called before the photographs are read and the hull is known.
        """
        points = self._config.points.count
        self._check(self._planned(points, 0.0, step=0))

    def check_points(
        self, grid: Grid, points: int, depth_range: tuple[float, float], step: int = 0
    ) -> None:
        """Raise UserError, naming the settings to change, where a training with these points of a
        grid does not fit from a step on, or would refine the grid beyond what ids can number.
        """
        to_come = sum(step < at for at in refine_steps(self._config.train))
        if math.prod(grid.dims) * 8**to_come > MOST_VERTICES:
            raise UserError(
                f"refined {to_come} times, the grid has more than {MOST_VERTICES} vertices:"
                " refine less often (train.refine_at), or lower --points"
            )
        self._check(self.plan_points(grid, points, depth_range, step))

    def check_growth(self, model: Model, step: int) -> None:
        """Check again if the step after `step` refines the grid or begins the EMA: only now it is
        known how many points pruning has left.
        """
        train, points = self._config.train, model.cloud.count
        if step + 1 in refine_steps(train) or (train.ema and step + 1 == _averages(train)):
            try:
                self.check_points(model.grid, points, model.depth_range, step)
            except UserError as error:
                raise UserError(
                    f"step {step}: to go on with {points} points, {error}, in another --out"
                ) from None

    def plan_points(
        self, grid: Grid, points: int, depth_range: tuple[float, float], step: int = 0
    ) -> Plan:
        """The memory of a training with these points from a step on, seen from the middle of the
        depth range. Pairs and points after prunings to come are estimates.
        """
        middle = sum(depth_range) / 2
        # footprints grow by 1 / (z^2 cos) nearer by and off the axis: the mean over a cube, to
        # second order
        growth = 1 + (grid.diagonal / middle) ** 2 / 9
        radius = point_radius(self._config.raster, grid.edge, depth_range)
        pixels = radius * self._largest.fx / middle * math.sqrt(growth)
        return self._planned(points, pixels, step)

    def _check(self, plan):
        problem, lower = self._problem(plan)
        if problem:
            raise UserError(f"{problem}: {lower}, or choose another device (`pp-cl devices`)")
        self.plan = plan

    def _problem(self, plan):
        """(what does not fit, what to do about it); ("", "") if all fits."""
        dev, info, (what, largest) = self.dev, self.dev.info, plan.largest
        device, host, available = plan.peak.device, plan.host(dev.is_cpu), available_bytes()
        lower = "lower --points or train.crop, or raise --downscale"
        if largest > info["max_allocation_bytes"]:
            most = _size(info["max_allocation_bytes"])
            return (
                f"a buffer of {_size(largest)} ({what}) is more than the {most} that {dev.name}"
                " allocates at once",
                lower,
            )
        if device > info["memory_bytes"]:
            has = _size(info["memory_bytes"])
            return f"the training needs {_size(device)}, {dev.name} has {has}", lower
        if available is not None and host > available - self._program:
            free = _size(max(0, available - self._program))
            return f"the training needs {_size(host)} of the host's memory, {free} are free", lower
        budget = self._config.train.memory_gib
        if budget and device > budget * GIB:
            needed = math.ceil(device / GIB * 100) / 100
            return (
                f"--memory {budget:g}: the training needs {_size(device)}",
                f"give --memory {needed:g}, {lower}",
            )
        return "", ""

    # ---- the plan

    def _planned(self, points, radius, step):
        """radius: of the footprints, pixels of the largest photograph as it is stored."""
        _, beside = reading(self._photographs, mask_rule(self._config), self._shrunk())
        return Plan(
            self._phases(points, radius, step),
            photographs=kept_bytes(self._sizes, self._shrunk()),
            reading=0 if self._config.scene.path == DEMO else beside,
        )

    def _phases(self, n, radius, step):
        """The phases from a step on: each level of refinement, each refining, and the EMA at the
        end.
        """
        train, phases = self._config.train, []
        averages, refinements = _averages(train), refine_steps(train)
        for level, end in enumerate([*refinements, train.iterations]):
            start = refinements[level - 1] if level else 0
            if end <= step:
                continue
            now, left = max(start, step), len(refinements) - level
            prunes, to_come = prunings(train, start, end), prunings(train, now, end)
            stages = {"radius": radius, "left": left}
            name = f"from step {now} on"
            phases.append(self._level(name, n, averages <= now, prunes > 0, **stages))
            n = round(n * KEPT_BY_PRUNING ** (to_come / max(1, prunes)))
            if left:
                phases.append(self._refining(end, n, averages <= end, **stages))
                n *= 8
                radius /= 2 if self._config.raster.footprint == "soft" else 1
            elif now < averages < end:
                name = f"averages, from step {averages} on"
                phases.append(self._level(name, n, True, prunes > 0, **stages))
        return phases

    def _level(self, name, n, is_averaged, prunes, **stages):
        """The phase of one level of refinement, with its prunings and checkpoints."""
        views = self._views(n, **stages)
        if prunes:  # the renderer has released its buffers then
            pruning = {"pruning (at most)": compact_table(n, 64 * self._most_coefficients)}
            views = max(views, pruning, key=_bytes)
        tables = self._point_tables(n, is_averaged) | self._stages(n, **stages) | views
        host = PRUNING_BYTES * n * prunes + 2 * min(PIECE_BYTES, 64 * 8 * n)
        return MemoryPhase(name, n, tables, host)

    def _refining(self, step, n, is_averaged, **stages):
        """Old and new arrays of the points live together, one array after the other, beside the
        buffers of the stages but the renderer's.
        """
        old = (n, self._most_coefficients, 16), np.float32
        tables = self._point_tables(8 * n, is_averaged) | self._stages(n, **stages)
        tables["refining"] = {"rows": ((8 * n,), np.uint32), "old": old}
        return MemoryPhase(f"refining after step {step}", 8 * n, tables, REFINING_BYTES * n)

    @property
    def _most_coefficients(self):
        """Of a point in one array."""
        return max(block.count for block in self._blocks)

    @property
    def _blocks(self):
        return sh_blocks(self._config.points.sh_degree)

    def _point_tables(self, n, is_averaged):
        """What stays from step to step."""
        averages = PointState.ema_table(n, self._blocks) if is_averaged else {}
        return {
            "points": PointCloud.table(n, self._blocks),
            "training state of the points": PointState.table(n),
            "averages of the points": averages,
            "optimiser": Optimiser.table(self._net.all_parameters, is_averaged),
        }

    def _sizes_seen(self, left):
        """(height, width) of a step's crop, of that padded, of a padded preview."""
        camera, downscale = self._largest, self._config.scene.downscale
        side = crop_side(self._config.train.crop, left)
        width, height = _crop(camera.downscaled(downscale << left), side)
        full = _padded(*_crop(camera.downscaled(downscale), 0))
        return (height, width), _padded(width, height), full

    def _views(self, n, *, radius, left):
        """What the renderer takes for a step or for a preview, whichever is more."""
        raster, (_, crop, full) = self._config.raster, self._sizes_seen(left)
        area = math.pi * max(LEAST_RADIUS, radius / self._config.scene.downscale) ** 2
        share = min(1.0, CROP_SHARE * math.prod(crop) / math.prod(full))
        pairs = n * min(area, math.prod(full))
        few, many = (grown(0, round(s * pairs)) for s in (share, 1.0))
        shown = n if raster.early_stop == 0 else round(SHOWN * n)
        shaded = round(share * shown)
        step = Renderer.tables(raster, n, crop, few, shaded, by_pair=True)
        gradients = blend_backward_table(shaded, math.prod(crop), few, raster.blend)
        step["gradients (estimate)"] = gradients
        return max(step, Renderer.tables(raster, n, full, many, shown, by_pair=False), key=_bytes)

    def _stages(self, n, *, radius, left):
        """What the other stages of a step and of a rendered preview take. left: refinements to
        come.
        """
        config, net, camera = self._config, self._net, self._largest
        train, ((height, width), crop, full) = config.train, self._sizes_seen(left)
        target, shrunk = (height, width, 3), self._shrunk()
        tables = {
            f"network at {crop[1]}x{crop[0]}": net.memory_plan(*crop, True),
            f"previews at {full[1]}x{full[0]}": _preview_table(net, full),
            "loss": Loss.table((*crop, 3), target, train.ssim_weight, lanes_of_loss(net.dev)),
            "photograph and target": {
                "image": ((camera.height // shrunk, camera.width // shrunk, 4), np.uint8),
                "target": (target, np.float32),
                "alpha": (target[:2], np.float32),
            },
        }
        if train.sh_smoothing > 0:
            tables["smoothing"] = Smoother.table(n)
        if train.mask_weight > 0:
            tables["mask loss"] = MaskLoss.table(*crop)
        if train.exposure != "off":
            state = {"state": ((len(self._photographs), 3, 4), np.float32)}
            tables["exposure"] = Exposure.table(height, width) | state
        return tables

    def _shrunk(self):
        """How many times the photographs are reduced while they are read."""
        scene = self._config.scene
        return 1 if scene.path == DEMO else shrink_factor(self._sizes, scene.downscale)

    @property
    def _sizes(self):
        """[(width, height)] of the photographs in their files."""
        return [(one.camera.width, one.camera.height) for one in self._photographs]


def _bytes(tables):
    """Of all buffers of several tables."""
    return sum(map(table_bytes, tables.values()))


def _averages(train):
    """The step from which on averages are kept, infinite for never."""
    return ema_start(train.iterations) if train.ema else math.inf


def _crop(camera, side):
    """(width, height) of a crop; side 0: the whole image."""
    return tuple(min(side, size) if side else size for size in (camera.width, camera.height))


def _padded(width, height):
    """(height, width) in whole multiples of what the network needs."""
    return height + -height % NETWORK_MULTIPLE, width + -width % NETWORK_MULTIPLE


def _preview_table(net, size):
    """The buffers of whole images that are rendered, beside the network's parameters."""
    plan = net.memory_plan(*size, False)
    return {name: row for name, row in plan.items() if name not in PARAMETERS}


def _size(size):
    """Bytes in a unit that shows three digits."""
    return f"{size / GIB:.2f} GiB" if size >= GIB else f"{size / MIB:.3g} MiB"


def plan_lines(plan: Plan, dev: Device) -> list[str]:
    """The plan as text: device and host at their peaks in one line, then the device's buffers."""
    peak, (what, largest) = plan.peak, plan.largest
    rows = [(what, len(table), table_bytes(table)) for what, table in peak.tables.items() if table]
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
