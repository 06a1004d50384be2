"""The memory a training will take, summed over the tables of its stages before they allocate."""

import math

import numpy as np

from pp_cl.config import Config
from pp_cl.device.buffers import Table, grown, table_bytes
from pp_cl.device.compact import compact_table
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.metrics.lpips import Lpips
from pp_cl.model import Model
from pp_cl.raster.blend import BLENDS, Blend
from pp_cl.raster.pairs import PairBuilder
from pp_cl.raster.point_cloud import PointCloud
from pp_cl.raster.project import Projection
from pp_cl.render import NETWORK_MULTIPLE, Renderer
from pp_cl.scene.camera import Camera
from pp_cl.scene.views import View
from pp_cl.settings import RasterConfig
from pp_cl.training.loss import Loss, lanes_of_loss
from pp_cl.training.mask import MaskLoss
from pp_cl.training.optimiser import Optimiser
from pp_cl.training.perceptual import PerceptualLoss
from pp_cl.training.point_state import PointState
from pp_cl.training.smooth import Smoother, chunk_points

MIB, GIB = 2**20, 2**30
REFINED = (
    4.5  # times as many points after a refinement: half of them are pruned in the course of it
)

Plan = list[tuple[str, Table]]  # what the buffers of each table are for


def memory_plan(config: Config, model: Model, views: list[View], refinements: int = 0) -> Plan:
    """The device buffers of a training with this model on these views, at its most points and for
    the largest of its crops.

    refinements: of the grid that are still to come; the points after them are an estimate.
    """
    train, blocks = config.train, model.cloud.blocks
    n = round(model.cloud.count * REFINED**refinements)
    edge = model.grid.edge / 2**refinements
    view = max(views, key=lambda v: (math.prod(v.crop_size(train.crop)), v.camera.fx))
    camera, photograph = view.camera, max((v.image for v in views), key=lambda image: image.size)
    width, height = view.crop_size(train.crop)
    padded, _, _ = camera.crop(0, 0, width, height).padded(NETWORK_MULTIPLE)
    size = (padded.height, padded.width)
    image, target = (*size, 3), (height, width, 3)
    row_bytes = max(64 * block.count for block in blocks)  # of the largest array of a point
    return [
        ("points", PointCloud.table(n, blocks)),
        ("training state of the points", PointState.table(n, blocks, train)),
        ("averages of the points", PointState.ema_table(n, blocks) if train.ema else {}),
        ("optimiser", Optimiser.table(n, model.net.parameters, train)),
        ("smoothing (estimate)", _smoothing_table(config, model, n)),
        ("pruning (at most)", compact_table(n, row_bytes)),
        *_raster_tables(
            config.raster, n, size, n * _pixels_per_point(config.raster, model, camera, edge)
        ),
        (f"network at {size[1]}x{size[0]}", _network_table(model, size)),
        ("loss", Loss.table(image, target, train.ssim_weight, lanes_of_loss(model.net.dev))),
        ("mask loss", MaskLoss.table(*size) if train.mask_weight else {}),
        *(_perceptual_tables(model.net, target) if train.perceptual_weight else ()),
        (
            "photograph and target",
            {
                "image": (photograph.shape, np.uint8),
                "target": (target, np.float32),
                "alpha": (target[:2], np.float32),
            },
        ),
    ]


def _smoothing_table(config, model, n):
    """The Smoother's. Its chunk depends on the neighbours, which are not known yet: they are about
    a layer of the grid apart.
    """
    if config.train.sh_smoothing == 0:
        return {}
    layers = model.grid.dims[2] * (n / model.cloud.count) ** (1 / 3)
    return Smoother.table(n, chunk_points(n, round(n / layers)))


def _network_table(model, size):
    plan = model.net.memory_plan(*size, True)
    return {f"{i} {name}": (shape, np.float32) for i, (name, shape, _) in enumerate(plan)}


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
    has_roles = settings.early_stop > 0 or settings.tau > 0 or settings.max_tracked > 0
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


def _pixels_per_point(settings: RasterConfig, model: Model, camera: Camera, edge: float) -> float:
    """Mean area of a footprint in pixels, seen from the middle of the depth range."""
    middle = sum(model.depth_range) / 2
    radius = 0.75  # the hard disc
    if settings.footprint == "soft":
        radius = max(radius, settings.radius * edge * camera.fx / middle)
    return math.pi * radius**2


def plan_bytes(plan: Plan) -> int:
    """Bytes of all buffers of a plan."""
    return sum(table_bytes(table) for _, table in plan)


def plan_lines(plan: Plan, dev: Device) -> list[str]:
    """The plan as text, against the device's limits."""
    rows = [(what, len(table), table_bytes(table)) for what, table in plan if table]
    rows.append(("total", sum(number for _, number, _ in rows), plan_bytes(plan)))
    return [
        f"memory plan ({dev.name}: {dev.info['memory_bytes'] / MIB:.0f} MiB, at most"
        f" {dev.info['max_allocation_bytes'] / MIB:.0f} at once)",
        *(f"  {what:30s} {number:4d} buffers {size / MIB:9.1f} MiB" for what, number, size in rows),
    ]


def spare_memory(plan: Plan, dev: Device, limit: float) -> int:
    """Bytes that a plan leaves of `limit` GiB; 0 without a limit. Raises UserError naming the
    settings where it takes more than the limit, or than the device has.
    """
    needed, available = plan_bytes(plan), dev.info["memory_bytes"]
    if needed > available:
        raise UserError(
            f"the training needs {needed / MIB:.0f} MiB, {dev.name} has {available / MIB:.0f}:"
            " lower --points, raise --downscale, or set train.moments_16bit, train.crop or smaller"
            " network.widths"
        )
    if limit and limit * GIB < needed:
        raise UserError(
            f"--memory {limit:g}: the training needs {needed / GIB:.2f} GiB; raise it, lower"
            " --points, raise --downscale, or set train.crop or smaller network.widths"
        )
    return max(0, int(limit * GIB) - needed)
