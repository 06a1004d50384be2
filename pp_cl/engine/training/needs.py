"""Predicts a training's memory, within 15 %, from the tables of its buffers for the expected
numbers of points, tiles and pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.buffers import Table, grown, table_bytes
from pp_cl.engine.grid import Grid
from pp_cl.engine.model import REFINING_BYTES
from pp_cl.engine.network.specular import Specular
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud, sh_blocks
from pp_cl.engine.raster.project import tiles_of, touched_tiles
from pp_cl.engine.render import point_radius, view_table
from pp_cl.engine.training.crops import crop_side
from pp_cl.engine.training.depth_loss import depth_loss_table
from pp_cl.engine.training.loss import loss_table
from pp_cl.engine.training.optim import network_state_table
from pp_cl.engine.training.schedule import Stretch, expected_stretches
from pp_cl.engine.training.smooth import smoothing_table
from pp_cl.engine.training.specular import SIDE, fit_table
from pp_cl.engine.training.state import PointState
from pp_cl.engine.training.target import target_table
from pp_cl.settings import Config

# A crop's share of the points is this many times its share of an image's pixels: up to 4 times on
# lego, where an image shows the object on a third of its pixels.
CROP_SHARE = 4
# The share of the points that an image shows at first, when they are fog; it shows all if no
# fragments are dropped.
SHOWN = 0.8


class Need(NamedTuple):
    """Bytes that a training needs. device: the device's peak, which it reaches with `points`
    points. largest: the largest buffer. host: host memory besides the program's own, including a
    CPU's buffers.
    """

    device: int
    points: int
    largest: int
    host: int


class Needs:
    """Predicts what trainings of a network on the same views need. largest: camera of the largest
    image, as stored. pixels: of all images, as stored. image_bytes: of the largest image on the
    device.
    """

    def __init__(self, net: UNet, largest: Camera, pixels: int, image_bytes: int):
        self._net, self._largest = net, largest
        self._pixels, self._image_bytes = pixels, image_bytes
        self._layer: Table = Specular(net.dev).table((SIDE, SIDE), (SIDE, SIDE))

    def expected(
        self,
        config: Config,
        points: int,
        progress: float = 0.0,
        grid: Grid | None = None,
        depth_range: tuple[float, float] = (0.0, 0.0),
    ) -> Iterator[Need]:
        """Yield the Need of each stretch that a training has from this progress on, when it has
        `points` points of the grid; without a grid, points with the smallest footprints. Its `host`
        is what refining after the stretch takes.
        """
        radius = self._radius(config.raster, grid, depth_range) if grid else 0.0
        stretches = [*expected_stretches(config.train, points, progress)]
        for stretch in stretches:
            # soft points are as wide as the spacing of points, and refining halves it
            halved = stretches[0].refinements - stretch.refinements
            width = radius / 2**halved if config.raster.footprint == "soft" else radius
            yield self._need_of(config, stretch, width / config.scene.downscale)

    def _radius(self, settings, grid, depth_range):
        """The mean radius of the footprints of a grid's points in the largest image, in pixels of
        the stored image.
        """
        middle = sum(depth_range) / 2
        # footprints grow by 1 / (z^2 cos) nearer by and off the axis: this is the mean over a cube,
        # to second order
        growth = 1 + (grid.diagonal / middle) ** 2 / 9
        radius = point_radius(settings, grid.voxel_size, depth_range)
        return radius * (self._largest.fx / middle * math.sqrt(growth))

    def _need_of(self, config: Config, stretch: Stretch, radius: float) -> Need:
        """The Need of one stretch. radius: of footprints in it, in pixels of the reduced image."""
        raster, train, n = config.raster, config.train, stretch.points
        downscale, halvings = config.scene.downscale, stretch.refinements
        crop = self._padded_size(downscale << halvings, crop_side(train.crop, halvings))
        image = self._padded_size(downscale, 0)
        side, dev = stretch.supersampling, self._net.dev
        tiles = math.prod(tiles_of(image, side))
        pairs = grown(0, round(n * min(touched_tiles(radius, side), tiles)))
        visible = n if raster.early_stop == 0 else round(SHOWN * n)
        share = min(1.0, CROP_SHARE * math.prod(crop) / math.prod(image))
        of_crop = crop, round(share * pairs), round(share * visible)
        of_step = view_table(dev, raster, n, *of_crop, training=True, supersampling=side)
        of_preview = view_table(dev, raster, n, image, pairs, visible, supersampling=side)

        held: list[Table] = [
            PointCloud.table(n, sh_blocks(config.points.sh_degree)),
            PointState.table(n),
            PointState.ema_table(n if stretch.is_averaged else 0),
            smoothing_table(n if train.sh_smoothing > 0 else 0),
            self._net.table(crop, image),
            network_state_table(self._net.all_parameters.size, stretch.is_averaged),
            loss_table(dev, crop, crop, train.ssim_weight),
            depth_loss_table(math.prod(crop) if train.depth_weight > 0 else 0),
            {"image": ((self._image_bytes,), np.uint8)},
        ]
        is_last, of_views = stretch.refinements == 0, [of_preview, target_table(image)]
        if is_last and train.specular == "auto" and raster.blend == "alpha":
            of_views += [self._layer, fit_table(dev, self._pixels // downscale**2)]
        taking_turns = [[of_step, target_table(crop)], of_views]
        device = _bytes(held) + max(map(_bytes, taking_turns))
        tables = [*held, *(table for turn in taking_turns for table in turn)]
        largest = max(table_bytes({"": row}) for table in tables for row in table.values())
        return Need(device, n, largest, n * REFINING_BYTES if stretch.refinements else 0)

    def _padded_size(self, downscale, side):
        """(height, width) of a crop of the largest image, or of it all, padded for the network."""
        camera = self._largest.downscaled(downscale)
        height, width = (min(side or size, size) for size in (camera.height, camera.width))
        return height + -height % UNet.multiple, width + -width % UNet.multiple


def _bytes(tables):
    return sum(map(table_bytes, tables))
