"""Whether a training fits the memory of device and host, and which settings make it fit."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from pp_cl.config import Config
from pp_cl.device.host import available_bytes, resident_bytes
from pp_cl.errors import UserError
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.scene.grid import Grid
from pp_cl.scene.hull import TOLERANCE
from pp_cl.scene.views import MIN_SIDE, Photograph
from pp_cl.training.memory import GIB, MIB, Plan, Sketch, memory_plan

# What a driver's compiler takes of the host until all kernels of a training are built, measured;
# of a platform that is not listed the most.
DRIVER_BYTES = {"Portable Computing Language": 80 * MIB, "Intel(R) OpenCL": 620 * MIB}
LEAST_POINTS, LEAST_CROP, MOST_DOWNSCALE = 1000, 32, 64


class Limits(NamedTuple):
    """What there is, in bytes. once: of one buffer; device: of all; host: of what a training may
    take, None where the system does not tell. is_cpu: the device's buffers are the host's memory.
    budget: the setting train.memory_gib, 0: none.
    """

    name: str
    is_cpu: bool
    once: int
    device: int
    host: int | None
    budget: int

    def problem(self, plan: Plan) -> str | None:
        """What of the plan is too much, in words; None where all fits."""
        what, largest = plan.largest
        device, host = plan.peak.device, plan.host(self.is_cpu)
        if largest > self.once:
            return (
                f"a buffer of {_size(largest)} ({what}) is more than the {_size(self.once)} that"
                f" {self.name} allocates at once"
            )
        if device > self.device:
            return f"the training needs {_size(device)}, {self.name} has {_size(self.device)}"
        if self.host is not None and host > self.host:
            return (
                f"the training needs {_size(host)} of the host's memory, {_size(self.host)} are"
                " free"
            )
        if self.budget and device > self.budget:
            return f"--memory {self.budget / GIB:g}: the training needs {_size(device)}"
        return None


class Room:
    """The memory there is for a training; made before anything of it is allocated.

    sketch: what was checked last, at first for a hull that is not known yet. plan: of that, None
    before. photographs: those of the training views.
    """

    def __init__(self, config: Config, net: UNet, photographs: Sequence[Photograph]):
        self.dev, self.plan = net.dev, None
        self.sketch = Sketch.unseen(config, net, photographs)
        driver = DRIVER_BYTES.get(self.dev.info["platform"], max(DRIVER_BYTES.values()))
        held = resident_bytes() - (self.dev.bytes if self.dev.is_cpu else 0)
        self._program = held + driver

    def check_unseen(self) -> None:
        """Raise UserError as check_points does, where the least that the training can take does not
        fit.
        """
        self._check(replace(self.sketch, radius=0.0), advised=self.sketch)

    def check_points(
        self, grid: Grid, points: int, depth_range: tuple[float, float], step: int = 0
    ) -> None:
        """Raise UserError where a training with these points of a grid at a step does not fit,
        naming the settings with which it does, each by itself.
        """
        sketch = self.sketch.on_grid(grid, points, depth_range, step)
        self._check(sketch, advised=sketch)

    def check_growth(self, model: Model, step: int) -> None:
        """Before the step after `step`: the same where it refines the grid or begins the averages,
        as it is known only now how many points are left.
        """
        points = model.cloud.count
        if step + 1 in (*self.sketch.refinements, self.sketch.averages):
            try:
                self.check_points(model.grid, points, model.depth_range, step)
            except UserError as error:
                raise UserError(f"step {step}: to go on with {points} points, {error}") from None

    @property
    def host_bytes(self) -> int:
        """What this process takes of the host at its peak, by the plan."""
        return self._program + self.plan.host(self.dev.is_cpu)

    def _check(self, sketch, advised):
        limits, plan = self._limits(), memory_plan(sketch)
        problem = limits.problem(plan)
        if problem is None:
            self.sketch, self.plan = advised, plan
            return
        advice = _advice(advised, limits)
        if not advice:
            raise UserError(f"{problem}: choose another device (`pp-cl devices`)")
        told = f"{problem}: {' or '.join(advice)} {'fits' if len(advice) == 1 else 'fit'}"
        raise UserError(told + (", in another --out" if sketch.step else ""))

    def _limits(self):
        """As they are now."""
        dev, available = self.dev, available_bytes()
        host = None if available is None else max(0, available - self._program)
        once, total = dev.info["max_allocation_bytes"], dev.info["memory_bytes"]
        budget = round(self.sketch.config.train.memory_gib * GIB)
        return Limits(dev.name, dev.is_cpu, once, total, host, budget)


def _advice(sketch, limits):
    """Settings that make it fit by themselves, else two that do together."""

    def fits(other):
        return limits.problem(memory_plan(other)) is None

    advice = []
    if limits.budget and limits._replace(budget=0).problem(plan := memory_plan(sketch)) is None:
        advice = [f"--memory {math.ceil(plan.peak.device / GIB * 100) / 100:g}"]
    return [*advice, *_alone(sketch, fits)] or [*_together(sketch, fits)]


Fits = Callable[[Sketch], bool]


def _alone(sketch: Sketch, fits: Fits) -> Iterator[str]:
    """The settings that make it fit by themselves."""
    if points := _most_points(sketch, fits):
        yield f"--points {points}"
    factors = range(sketch.config.scene.downscale + 1, _most_downscale(sketch) + 1)
    if found := next((k for k in factors if fits(sketch.with_settings(downscale=k))), None):
        yield f"--downscale {found}"
    crop = sketch.config.train.crop or min(min(size) for size in sketch.sizes)
    quads = range(LEAST_CROP // 4, crop // 4)
    if side := 4 * _most(quads, lambda quad: fits(sketch.with_settings(crop=4 * quad))):
        yield f"--set train.crop={side}"


def _together(sketch: Sketch, fits: Fits) -> Iterator[str]:
    """The least reduction of the images with which fewer points make it fit."""
    for downscale in range(sketch.config.scene.downscale + 1, _most_downscale(sketch) + 1):
        if points := _most_points(sketch.with_settings(downscale=downscale), fits):
            yield f"--downscale {downscale} --points {points}"
            return


def _most_points(sketch, fits):
    """The most points to ask for that fit, of two digits; 0 where too few would. A hull has up to
    TOLERANCE times as many; later on the present share of those asked for.
    """
    asked = sketch.config.points.count
    hull = sketch.points / asked if sketch.step else TOLERANCE

    def found(points):
        return fits(sketch.with_points(math.ceil(hull * points)))

    most = _most(range(LEAST_POINTS, asked), found)
    unit = 10 ** max(0, len(str(most)) - 2)
    return most // unit * unit


def _most_downscale(sketch):
    """That leaves every image enough pixels, those of the first level too."""
    least = min(min(size) for size in sketch.sizes)
    return min(MOST_DOWNSCALE, least // MIN_SIDE >> len(sketch.refinements))


def _most(values, holds):
    """The last of the ascending `values` for which holds() is true, as it is for all before; 0
    where it is for none.
    """
    if not values or not holds(values[0]):
        return 0
    low, high = 1, len(values)
    while low < high:
        middle = (low + high) // 2
        low, high = (middle + 1, high) if holds(values[middle]) else (low, middle)
    return values[low - 1]


def _size(size):
    """Bytes in a unit that shows three digits."""
    return f"{size / GIB:.2f} GiB" if size >= GIB else f"{size / MIB:.3g} MiB"
