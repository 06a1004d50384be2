"""The memory a training will take, as a table made before it is taken."""

import math

from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.raster.sh import sh_blocks
from pp_cl.render import NETWORK_MULTIPLE
from pp_cl.training.prune import SCRATCH_BYTES
from pp_cl.training.smooth import CHUNK

MIB, GIB = 2**20, 2**30

Plan = list[tuple[str, str, int]]  # what the buffers are for, their shapes as text, bytes
# two keys of 8, pixel, closeness, point and two weights of 4 bytes, a quarter of spare room
PAIR_BYTES = 45


def point_bytes(train, degree):
    """{what: bytes on the device} of one point of a training. train: config.TrainConfig. degree: of
    the SH.
    """
    coefficients = 16 * sum(block.count for block in sh_blocks(degree))
    learned = 4 * (1 + coefficients)
    return {
        "ids, opacities, SH coefficients": 4 + learned,
        "Adam's moments": 2 * (4 + (2 if train.moments_16bit else 4) * coefficients),
        "averages": learned if train.ema else 0,
        # 4 of adam_rest; last steps, flags, offsets, rows
        "weights, Adam's lists": 4 * (1 + (8 if train.lazy_adam else 0)),
        # position, box, features, gradients, offsets and lists
        "points of one view": 4 * (4 + 2 + 16 + 16 + 1 + 3),
        "neighbours": 4 * 6 if train.sh_smoothing > 0 else 0,
    }


def memory_plan(dev, config, model, views):
    """[(what, shape text, bytes)] of the device buffers of a training with this model on these
    views.
    """
    n, train = model.count, config.train
    camera = views[0].camera
    width, height = (
        side + -side % NETWORK_MULTIPLE for side in train.crop_size(camera.width, camera.height)
    )
    rows = [
        (what, f"({n}) x {size} bytes", n * size)
        for what, size in point_bytes(train, model.degree).items()
        if size
    ]
    row_bytes = max(64 * block.count for block in model.blocks)  # of the largest array of a point
    if train.sh_smoothing > 0:
        chunk = min(n, max(CHUNK, n // model.grid.dims[2]))  # the points of a layer, about
        rows.append(
            ("smoothing (estimate)", f"2 x ({chunk}) x {row_bytes} bytes", 2 * chunk * row_bytes)
        )
    rows.append(("pruning", "at most", min(SCRATCH_BYTES, n * row_bytes)))
    if config.raster.early_stop > 0 or config.raster.tau > 0:
        rows.append(("points kept in one view", f"({n}) x 12 bytes", 12 * n))
    pairs = round(n * _pixels_per_point(config, model, camera))
    rows.append(
        ("point-pixel pairs (estimate)", f"({pairs}) x {PAIR_BYTES} bytes", PAIR_BYTES * pairs)
    )
    network = model.net.memory_plan(height, width, True)
    rows.append(
        (
            f"network at {width}x{height}",
            f"{len(network)} buffers",
            sum(size for _, _, size in network),
        )
    )
    image = views[0].image
    rows.append(
        (
            "image, target, loss",
            f"({height}, {width}, 3) x 12",
            image.nbytes + 4 * height * width * 3 * 12,
        )
    )
    return rows


def _pixels_per_point(config, model, camera):
    """Mean area of a footprint in pixels, seen from the middle of the depth range."""
    middle = sum(model.depth_range) / 2
    radius = 0.75  # the hard disc
    if config.raster.footprint == "soft":
        radius = max(radius, config.raster.radius * model.grid.edge * camera.fx / middle)
    return math.pi * radius**2


def plan_lines(plan: Plan, dev: Device) -> list[str]:
    """The plan as text, against the device's limits."""
    rows = [*plan, ("total", "", sum(size for _, _, size in plan))]
    return [
        f"memory plan ({dev.name}: {dev.info['memory_bytes'] / MIB:.0f} MiB, at most"
        f" {dev.info['max_allocation_bytes'] / MIB:.0f} at once)",
        *(f"  {what:36s} {shape:28s} {size / MIB:9.1f} MiB" for what, shape, size in rows),
    ]


def spare_memory(plan: Plan, dev: Device, limit: float) -> int:
    """Bytes that a plan leaves of `limit` GiB; 0 without a limit. Raises UserError naming the
    settings where it takes more than the limit, or than the device has.
    """
    needed, available = sum(size for _, _, size in plan), dev.info["memory_bytes"]
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
