"""Refuses a training that does not fit into the memory before it allocates;
engine/training/needs.py predicts what it needs.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import islice

from pp_cl.engine.device.buffers import PIECE_BYTES
from pp_cl.engine.device.host import available_bytes, resident_bytes
from pp_cl.engine.device.quirks import compiler_bytes
from pp_cl.engine.grid import MOST_IDS, Grid
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.training.needs import Need, Needs
from pp_cl.engine.training.schedule import refinements
from pp_cl.errors import UserError
from pp_cl.scene.image_file import ImageFile, image_bytes, shrink_factor
from pp_cl.scene.listing import DEMO
from pp_cl.scene.load import reading_cost
from pp_cl.settings import Config

MIB, GIB = 2**20, 2**30
# If memory is too small for all points, a training goes on only with at least this share of them:
# about enough if pruning leaves the most beyond LEFT_BY_PRUNING, in two refinements.
LEAST_KEPT = 0.5
# The share of the memory to fill if memory decides the number of points: plans err by a few
# percent.
FILLED = 0.9


class MemoryPlan:
    """Checks, before a training allocates anything, that it fits the available memory. need: result
    of the last check. budget: --memory, GiB. image_files: of the training views.
    """

    def __init__(self, config: Config, net: UNet, image_files: Sequence[ImageFile]):
        self.dev = net.dev
        self.need: Need
        self.follow(config)
        self.budget = config.train.memory_gib
        downscale, is_demo = config.scene.downscale, config.scene.path == DEMO
        cameras = [image_file.camera for image_file in image_files]
        sizes = [(camera.width, camera.height) for camera in cameras]
        factor = 1 if is_demo else shrink_factor(sizes, downscale)
        self._images = image_bytes(sizes, factor)
        largest = max(cameras, key=lambda camera: (camera.width * camera.height, camera.fx))
        image = image_bytes([(largest.width, largest.height)], factor)
        self._needs = Needs(net, largest, sum(map(math.prod, sizes)), image)
        self._reading_bytes = 0 if is_demo else reading_cost(image_files, config.scene, factor)[1]
        held = self.dev.bytes if self.dev.is_cpu else 0  # `need` counts these
        self._program = resident_bytes() - held + compiler_bytes(self.dev.info)

    def follow(self, config: Config) -> None:
        """Check a training of the same scene with these settings from now on."""
        self._config = config

    @property
    def host_bytes(self) -> int:
        """Host memory in bytes that this process takes at its peak, by the last check."""
        return self._program + self.need.host

    def check_unseen(self) -> None:
        """Raise UserError if even the least memory that the training can take does not fit; called
        before the images are read and the hull is known.
        """
        least = replace(self._config, train=replace(self._config.train, supersampled=0.0))
        self.need = self._need(self._needs.expected(least, least.points.count))
        if fault := self._fault(self.need):
            raise UserError(": ".join(fault))

    def check_points(
        self, grid: Grid, points: int, depth_range: tuple[float, float], progress: float = 0.0
    ) -> None:
        """Raise UserError if a training with these points of a grid does not fit from then on,
        or if refining gives the grid more vertices than ids can number.
        """
        self.need = self.need_of(grid, points, depth_range, progress)
        if fault := self.fault_of(grid, points, depth_range, progress):
            raise UserError(": ".join(fault))

    def points_that_fit(
        self, grid: Grid, points: int, depth_range: tuple[float, float], progress: float
    ) -> int:
        """The largest number of these points with which a training fits from then on; the
        others must be dropped before it takes more memory. Raises UserError as check_points() does
        if that is less than LEAST_KEPT of them, or if not even the next steps fit.
        """
        most, start = points, self.need_of(grid, points, depth_range, progress, stretches=1)
        if not self._fault(start) and self.fault_of(grid, points, depth_range, progress):
            kept = _most(points, lambda n: self.fault_of(grid, n, depth_range, progress, FILLED))
            most = kept if kept >= LEAST_KEPT * points else points
        self.check_points(grid, most, depth_range, progress)
        return most

    def coarser_points(self, grid: Grid, points: int, depth_range: tuple[float, float]) -> int:
        """The largest number of points, at most `points`, with which a training fits that begins
        with a coarser grid; 0 if none fits.
        """

        def fault(count):
            times = (points / count) ** (1 / 3)
            dims = tuple(max(1, round(n / times)) for n in grid.dims)
            coarser = replace(grid, voxel_size=times * grid.voxel_size, dims=dims)
            return self.fault_of(coarser, count, depth_range, share=FILLED)

        return _most(points, fault)

    def fault_of(
        self,
        grid: Grid,
        points: int,
        depth_range: tuple[float, float],
        progress: float = 0.0,
        share: float = 1.0,
    ) -> tuple[str, str] | None:
        """(why a training with these points of a grid does not fit into a share of the memory from
        then on, what to do), or None if it fits.
        """
        to_come = sum(progress < at for at in refinements(self._config.train))
        last = reduce(lambda finer, _: finer.refined(), range(to_come), grid)
        if last.id_count > MOST_IDS:
            return (
                f"refined {to_come} times, the grid has more than {MOST_IDS} vertices",
                "refine less often (train.refine_at), or lower --points",
            )
        return self._fault(self.need_of(grid, points, depth_range, progress), share)

    def need_of(
        self,
        grid: Grid,
        points: int,
        depth_range: tuple[float, float],
        progress: float = 0.0,
        stretches: int | None = None,
    ) -> Need:
        """The Need of a training with these points of a grid from then on. stretches: how many
        stretches to look ahead, each of which ends where more memory is taken; None: all.
        """
        needs = self._needs.expected(self._config, points, progress, grid, depth_range)
        return self._need(islice(needs, stretches))

    def _need(self, of_stretches):
        """The Need of a training with these of its stretches."""
        needs = [*of_stretches]
        peak, largest = max(needs), max(need.largest for need in needs)
        host = 2 * PIECE_BYTES + max(need.host for need in needs) + self.dev.is_cpu * peak.device
        host = self._images + max(host, self._reading_bytes)
        return peak._replace(largest=largest, host=host)

    def _fault(self, need, share=1.0):
        info, name = self.dev.info, self.dev.name
        lower, available = "lower --points or train.crop, or raise --downscale", available_bytes()
        free = max(0, available - self._program)
        if need.largest > info["max_allocation_bytes"]:
            most = _size(info["max_allocation_bytes"])
            why = f"a buffer of {_size(need.largest)} is more than the {most} that {name} allocates"
            why += " at once"
        elif need.device > share * info["memory_bytes"]:
            has = _size(info["memory_bytes"])
            why = f"the training needs {_size(need.device)}, {name} has {has}"
        elif need.host > share * free:
            why = f"the training needs {_size(need.host)} of the host's memory, {_size(free)} are"
            why += " free"
        elif self.budget and need.device > share * self.budget * GIB:
            why = f"--memory {self.budget:g}: the training needs {_size(need.device)}"
            lower = f"give --memory {math.ceil(need.device / GIB * 100) / 100:g}, {lower}"
        else:
            return None
        return why, f"{lower}, or choose another device (`pp-cl devices`)"


def _most(points, fault):
    """The largest n up to `points` without a fault(n), as smaller n have none; or 0."""
    return bisect_right(range(1, points + 1), False, key=lambda n: fault(n) is not None)


def _size(size):
    """Bytes in a unit that shows three digits."""
    return f"{size / GIB:.2f} GiB" if size >= GIB else f"{size / MIB:.3g} MiB"


def memory_line(memory_plan: MemoryPlan) -> str:
    """The memory that a training needs by the last check, as text."""
    need, dev, budget = memory_plan.need, memory_plan.dev, memory_plan.budget
    has, on_host = _size(dev.info["memory_bytes"]), f"{_size(need.host)} of the computer's"
    if dev.is_cpu:
        return f"memory: up to {on_host} {has}, with {need.points} points"
    of = f"--memory {budget:g}" if budget else f"the {has} of {dev.name}"
    on_device = f"{_size(need.device)} of {of}"
    return f"memory: up to {on_device}, with {need.points} points, and {on_host}"
