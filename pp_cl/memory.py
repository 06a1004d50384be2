"""The memory a training will take, as a table made before it is taken."""

import math

from pp_cl.errors import UserError
from pp_cl.points import SH_DEGREES
from pp_cl.scene import reduced_camera

MIB = 2**20
MOMENTS = 2  # Adam's
PAIR_BYTES = 45  # two keys of 8, pixel, closeness, point and two weights of 4 bytes, a quarter of spare room
POINT_VIEW_FLOATS = 4 + 2 + 16 + 16 + 1 + 3  # camera position, box, features, their gradient, opacity's, lists


def memory_plan(dev, config, model, views):
    """[(what, shape text, bytes)] of the device buffers of a training with this model on these views."""
    n, train = model.count, config.train
    camera = reduced_camera(views[0], config.scene.downscale)
    width, height = (
        (camera.width, camera.height) if train.crop == 0 else (min(train.crop, camera.width), min(train.crop, camera.height))
    )
    width, height = width + -width % 4, height + -height % 4
    copies = 1 + MOMENTS + (1 if train.average else 0)
    rows = [("point ids, opacities", f"({n}) x {1 + copies}", 4 * n * (1 + copies))]
    rows += [
        (
            f"SH degree {d}, moments" + (", average" if train.average else ""),
            f"({n}, {2 * d + 1}, 16) x {copies}",
            64 * n * (2 * d + 1) * copies,
        )
        for d in SH_DEGREES
    ]
    rows.append(("points of one view", f"({n}, {POINT_VIEW_FLOATS})", 4 * n * POINT_VIEW_FLOATS))
    if train.smooth > 0:
        rows.append(("neighbours, scratch (estimate)", f"({n}, 22)", 4 * n * 22))
    pairs = round(n * _pixels_per_point(config, model, camera))
    rows.append(("point-pixel pairs (estimate)", f"({pairs})", PAIR_BYTES * pairs))
    network = model.net.memory_plan(height, width, True)
    rows.append((f"network at {width}x{height}", f"{len(network)} buffers", sum(size for _, _, size in network)))
    image = views[0].image
    rows.append(("image, target, loss", f"({height}, {width}, 3) x 12", image.nbytes + 4 * height * width * 3 * 12))
    return rows


def _pixels_per_point(config, model, camera):
    """Mean area of a footprint in pixels, seen from the middle of the depth range."""
    middle = sum(model.depth_range) / 2
    radius = 0.75  # the hard disc
    if config.points.footprint == "soft":
        radius = max(radius, config.points.radius * model.grid.edge * camera.fx / middle)
    return math.pi * radius**2


def print_plan(rows, dev):
    """Print the table against the device's limits. Raises UserError naming the knobs when it does not fit."""
    total = sum(size for _, _, size in rows)
    print(
        f"memory plan ({dev.name}: {dev.info['memory_bytes'] / MIB:.0f} MiB, "
        f"at most {dev.info['max_allocation_bytes'] / MIB:.0f} at once)"
    )
    for what, shape, size in rows:
        print(f"  {what:36s} {shape:28s} {size / MIB:9.1f} MiB")
    print(f"  {'total':36s} {'':28s} {total / MIB:9.1f} MiB")
    if total > dev.info["memory_bytes"]:
        raise UserError(
            f"the training needs {total / MIB:.0f} MiB, {dev.name} has {dev.info['memory_bytes'] / MIB:.0f}: "
            "lower --points, raise --downscale, or set train.crop or smaller network.widths"
        )
