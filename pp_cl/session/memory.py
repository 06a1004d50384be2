"""A bound of the memory that a training takes, known before it allocates: the tables of its buffers
for its points, tile pairs, pixels and network.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pp_cl.engine.camera import divided
from pp_cl.engine.device.buffers import PIECE_BYTES, Table, grown, table_bytes
from pp_cl.engine.device.host import available_bytes, resident_bytes
from pp_cl.engine.device.quirks import compiler_bytes
from pp_cl.engine.grid import MOST_IDS, Grid
from pp_cl.engine.model import REFINING_BYTES
from pp_cl.engine.network.specular import Specular
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud, sh_blocks
from pp_cl.engine.raster.project import tiles_of, touched_tiles
from pp_cl.engine.render import point_radius, view_table
from pp_cl.engine.training.depth_loss import depth_loss_table
from pp_cl.engine.training.loss import loss_table
from pp_cl.engine.training.optim import network_state_table
from pp_cl.engine.training.schedule import (
    LEFT_BY_PRUNING,
    prunings,
    refinements,
    supersampling_at,
)
from pp_cl.engine.training.smooth import smoothing_table
from pp_cl.engine.training.specular import SIDE, fit_table
from pp_cl.engine.training.state import PointState
from pp_cl.engine.training.target import target_table
from pp_cl.errors import UserError
from pp_cl.scene.image_file import ImageFile, image_bytes, shrink_factor
from pp_cl.scene.listing import DEMO
from pp_cl.scene.load import reading_cost
from pp_cl.settings import Config

MIB, GIB = 2**20, 2**30
FILLED = 0.9  # share of the memory to fill if memory decides how far apart points are
CAREFUL = 1.08  # times the tables' bytes, as numbers of tile pairs are estimates
# A crop's share of the points is this many times its share of an image's pixels: up to 4 times on
# lego, where an image shows the object on a third of its pixels.
CROP_SHARE = 4
# The share of the points that an image shows at first, when they are fog.
SHOWN = 0.8

Fault = tuple[str, str]  # why a training does not fit, what to do


class Place(NamedTuple):
    """The points of a training at some time, and (near, far)."""

    grid: Grid
    points: int
    depth_range: tuple[float, float]

    def refined(self, times: int) -> "Place":
        """Return the place after refinements, with all of its points."""
        grid = self.grid
        for _ in range(times):
            grid = grid.refined()
        return self._replace(grid=grid, points=8**times * self.points)

    def spaced(self, count: int) -> "Place":
        """The same hull with about so many points in a coarser grid."""
        times = (self.points / count) ** (1 / 3)
        dims = tuple(max(1, round(n / times)) for n in self.grid.dims)
        grid = replace(self.grid, voxel_size=times * self.grid.voxel_size, dims=dims)
        return self._replace(grid=grid, points=count)


class Need(NamedTuple):
    """Bytes that a training takes at most. device: of the device, with `points` points. largest:
    the largest buffer. host: host memory besides the program's own, with a CPU's buffers.
    """

    device: int
    points: int
    largest: int
    host: int


class Memory:
    """What trainings of a network on the same views take, and what there is. The first may take
    `--memory` of the device's.
    """

    def __init__(self, config: Config, net: UNet, image_files: Sequence[ImageFile]):
        self.dev, self.budget, self._net = net.dev, config.train.memory_gib, net
        is_demo = config.scene.path == DEMO
        cameras = [image_file.camera for image_file in image_files]
        sizes = [(camera.width, camera.height) for camera in cameras]
        whole, ratio = divided(config.scene.downscale)
        factor = 1 if is_demo else shrink_factor(sizes, whole)
        fitted = [(int(width / ratio), int(height / ratio)) for width, height in sizes]
        self._images, self._pixels = image_bytes(fitted, factor), sum(map(math.prod, fitted))
        self._largest = max(cameras, key=lambda camera: (camera.width * camera.height, camera.fx))
        size = self._largest.width, self._largest.height
        self._image: Table = {"image": ((image_bytes([size], factor),), np.uint8)}
        self._layer: Table = Specular(net.dev).table((SIDE, SIDE), (SIDE, SIDE))
        self._reading_bytes = 0 if is_demo else reading_cost(image_files, config.scene, factor)[1]
        held = self.dev.bytes if self.dev.is_cpu else 0  # a Need counts these
        self._program = resident_bytes() - held + compiler_bytes(self.dev.info)

    def need(self, config: Config, place: Place | None = None, progress: float = 0.0) -> Need:
        """The Need of a training from a place and a progress on; None: of one with points.count
        points that have the smallest footprints.
        """
        train, raster, refining = config.train, config.raster, 0
        points, radius, shares = config.points.count, 0.0, refinements(config.train)
        last, to_come = max([0.0, *shares]), sum(progress < share for share in shares)
        some = train.minutes or prunings(train, round(last * train.iterations), train.iterations)
        is_pruned = train.prune_weight > 0 and some and progress <= last
        left = LEFT_BY_PRUNING if is_pruned else 1.0
        if place:
            before = round(place.points * (8 * left) ** to_come)
            grid, points, depth_range = place.refined(to_come)._replace(points=before)
            refining = points // 8 * REFINING_BYTES if to_come else 0
            middle = sum(depth_range) / 2
            # footprints grow by 1 / (z^2 cos) nearer by and off the axis: this is the mean over a
            # cube, to second order
            growth = math.sqrt(1 + (grid.diagonal / middle) ** 2 / 9)
            radius = point_radius(raster, grid.voxel_size, depth_range) / middle * growth
            radius *= self._largest.fx / config.scene.downscale
        foggy = self._phase(config, points, radius, is_late=False)
        late = self._phase(config, round(left * points), radius, is_late=True)
        device, largest = map(max, zip(foggy, late, strict=True))
        device = round(CAREFUL * device)
        host = 2 * PIECE_BYTES + refining + self.dev.is_cpu * device
        return Need(device, points, largest, self._images + max(host, self._reading_bytes))

    def _phase(self, config, n, radius, *, is_late):
        """(bytes in all, bytes of the largest buffer) of n points with footprints of a radius in
        pixels, at the images' full size. is_late: with averages, samples and specular layer.
        """
        raster, train, dev = config.raster, config.train, self._net.dev
        side = supersampling_at(float(is_late), train)
        image, crop = (self._padded(config, limit) for limit in (0, train.crop))
        pairs = n * min(touched_tiles(radius, side), math.prod(tiles_of(image, side)))
        pairs, visible = grown(0, round(pairs)), n if raster.early_stop == 0 else round(SHOWN * n)
        share = min(1.0, CROP_SHARE * math.prod(crop) / math.prod(image))
        seen = round(share * pairs), round(share * visible)
        step = view_table(dev, raster, n, crop, *seen, training=True, supersampling=side)
        view = view_table(dev, raster, n, image, pairs, visible, supersampling=side)
        is_averaged = train.ema and is_late
        held: list[Table] = [
            PointCloud.table(n, sh_blocks(config.points.sh_degree)),
            PointState.table(n),
            PointState.ema_table(n if is_averaged else 0),
            smoothing_table(n if train.sh_smoothing > 0 else 0),
            self._net.table(crop, image),
            network_state_table(self._net.all_parameters.size, is_averaged),
            loss_table(dev, crop, crop, train.ssim_weight),
            depth_loss_table(math.prod(crop) if train.depth_weight > 0 else 0),
            self._image,
        ]
        in_turn = [[step, target_table(crop)], [view, target_table(image)]]
        if is_late and train.specular == "auto" and raster.blend == "alpha":
            pixels = self._pixels // divided(config.scene.downscale)[0] ** 2
            in_turn[1] += [self._layer, fit_table(dev, pixels)]
        bytes_of = [sum(map(table_bytes, tables)) for tables in in_turn]
        tables = [*held, *in_turn[0], *in_turn[1]]
        largest = max(table_bytes({"": row}) for table in tables for row in table.values())
        return sum(map(table_bytes, held)) + max(bytes_of), largest

    def _padded(self, config, side):
        """(height, width) of a crop of the largest image, or of it all, padded for the network."""
        camera = self._largest.downscaled(config.scene.downscale)
        height, width = (min(side or size, size) for size in (camera.height, camera.width))
        return height + -height % UNet.multiple, width + -width % UNet.multiple

    def fault(
        self,
        config: Config,
        place: Place | None = None,
        progress: float = 0.0,
        share: float = 1.0,
    ) -> Fault | None:
        """Why the training of need() does not fit into a share of the memory; None if it does."""
        to_come = sum(progress < at for at in refinements(config.train))
        if place and place.refined(to_come).grid.id_count > MOST_IDS:
            return (
                f"refined {to_come} times, the grid has more than {MOST_IDS} vertices",
                "refine less often (train.refine_at), or lower --points",
            )
        need, info, name = self.need(config, place, progress), self.dev.info, self.dev.name
        lower = "lower --points or train.crop, or raise --downscale"
        free = max(0, available_bytes() - self._program)
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

    def check(self, config: Config, place: Place | None = None, progress: float = 0.0) -> None:
        """Raise UserError with the fault() of a training, if it has one."""
        if fault := self.fault(config, place, progress):
            raise UserError(": ".join(fault))

    def most_points(self, config: Config, place: Place) -> int:
        """The largest number of points with which a training fits that begins with a coarser grid
        of a place; 0 if none fits.
        """

        def is_too_many(count):
            return self.fault(config, place.spaced(count), share=FILLED) is not None

        return bisect_right(range(1, place.points + 1), False, key=is_too_many)

    def line(self, need: Need) -> str:
        """What a training takes at most, as text."""
        dev = self.dev
        has, on_host = _size(dev.info["memory_bytes"]), f"{_size(need.host)} of the computer's"
        if dev.is_cpu:
            return f"memory: up to {on_host} {has}, with {need.points} points"
        of = f"--memory {self.budget:g}" if self.budget else f"the {has} of {dev.name}"
        on_device = f"{_size(need.device)} of {of}"
        return f"memory: up to {on_device}, with {need.points} points, and {on_host}"


def _size(size):
    """Bytes in a unit that shows three digits."""
    return f"{size / GIB:.2f} GiB" if size >= GIB else f"{size / MIB:.3g} MiB"
