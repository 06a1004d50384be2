"""The memory that a training takes, from bytes a point, a pair and a pixel, within 15 % of what it
will allocate; a training that does not fit is refused before anything is allocated.
"""

import math
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import NamedTuple

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.buffers import table_bytes
from pp_cl.engine.device.host import available_bytes, resident_bytes
from pp_cl.engine.grid import MOST_IDS, Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud, sh_blocks
from pp_cl.engine.render import point_radius
from pp_cl.engine.training.crops import crop_side
from pp_cl.engine.training.schedule import ema_start, prunings, refine_steps
from pp_cl.engine.training.state import PointState
from pp_cl.errors import UserError
from pp_cl.scene.image_file import Photograph, kept_bytes, shrink_factor
from pp_cl.scene.load import DEMO, mask_rule, reading
from pp_cl.settings import Config

MIB, GIB = 2**20, 2**30

# Bytes on the device beside what a point learns: of each point in a view (its projection, its
# place in the lists of pairs and of visible points), of its neighbours, of a pair in an image, in
# one whose weights are listed by point (for the last pruning) and in a step (with slope and
# gradient), of a visible point's features in an image and in a step, and of a step's pixel
# (target, loss and features with their gradients).
VIEW_POINT, NEIGHBOURS = 45, 25
PAIR, LISTED_PAIR, TRAINED_PAIR = 28, 36, 40
FEATURES, TRAINED_FEATURES = 64, 148
TRAINED_PIXEL = 400
GROWN = 1.25  # arrays of pairs have this much more room than is needed
# By network.blocks: floats that the network holds for each pixel and channel of its top level in a
# training and in a rendering, and the channels of its largest buffer. Levels below have a quarter
# of the pixels of the one above.
MAPS = {"single": (4.5, 2.1, 1), "double": (6.0, 2.2, 1), "gated": (8.5, 3.0, 2)}
COPIES = 4  # of the network's parameters: themselves, gradient, two moments

# The share of the points that pruning leaves by the next refinement or the last step, about: 0.45
# to 0.73 on lego with the presets tiny, small and full.
KEPT_BY_PRUNING = 0.6
LEAST_RADIUS = 0.75  # pixels, as cl/raster/footprint.h has it
# How many times its share of an image's pixels a crop sees of the points: up to 4 times on lego,
# where an image shows the object on a third of its pixels.
CROP_SHARE = 4
# The share of the points that an image shows at first, when they are fog; all where no hits are
# dropped.
SHOWN = 0.8

# Bytes on the host: of refining, per point before it; of what a driver's compiler takes until all
# kernels of a training are built, of a platform that is not listed the most; of the pieces in
# which checkpoints are written.
REFINING = 320
DRIVER = {"Portable Computing Language": 80 * MIB, "Intel(R) OpenCL": 620 * MIB}
PIECES = 2 * 64 * MIB


class Need(NamedTuple):
    """Bytes that a training takes: of the device at its peak, and then of how many points; of the
    largest buffer; of the host beside the program itself, whose memory a CPU's buffers are in, too.
    """

    device: int
    points: int
    largest: int
    host: int


class Room:
    """Checks that a training fits the available memory; made before the training allocates
    anything. need: what it takes, by the last check.

    photographs: of the training views.
    """

    def __init__(self, config: Config, net: UNet, photographs: Sequence[Photograph]):
        self.dev = net.dev
        self.need: Need
        self._config = config
        self._net = net
        self._sizes = [(one.camera.width, one.camera.height) for one in photographs]
        cameras = [one.camera for one in photographs]
        self._largest = max(cameras, key=lambda camera: (camera.width * camera.height, camera.fx))
        shrunk = 1
        if config.scene.path != DEMO:
            shrunk = shrink_factor(self._sizes, config.scene.downscale)
        _, beside = reading(photographs, mask_rule(config), shrunk)
        self._reading = 0 if config.scene.path == DEMO else beside
        self._photographs = kept_bytes(self._sizes, shrunk)
        driver = DRIVER.get(self.dev.info["platform"], max(DRIVER.values()))
        self._program = resident_bytes() - (self.dev.bytes if self.dev.is_cpu else 0) + driver

    @property
    def host_bytes(self) -> int:
        """What this process takes of the host at its peak, by the last check."""
        return self._program + self.need.host

    def check_unseen(self) -> None:
        """Raise UserError as check_points() does if even the least memory that the training can
        take does not fit; called before the photographs are read and the hull is known.
        """
        self._check(self._needed(self._config.points.count, 0.0, step=0))

    def check_points(
        self, grid: Grid, points: int, depth_range: tuple[float, float], step: int = 0
    ) -> None:
        """Raise UserError, naming the settings to change, where a training with these points of a
        grid does not fit from a step on, or would refine the grid beyond what ids can number.
        """
        to_come = sum(step < at for at in refine_steps(self._config.train))
        last = reduce(lambda finer, _: finer.refined(), range(to_come), grid)
        if last.id_count > MOST_IDS:
            raise UserError(
                f"refined {to_come} times, the grid has more than {MOST_IDS} vertices:"
                " refine less often (train.refine_at), or lower --points"
            )
        self._check(self.need_of(grid, points, depth_range, step))

    def check_growth(self, model: Model, step: int) -> None:
        """Check again if the step after `step` refines the grid or begins the EMA: only now it is
        known how many points pruning has left.
        """
        train, points = self._config.train, model.cloud.count
        if step + 1 in [*refine_steps(train), _averages(train)]:
            try:
                self.check_points(model.grid, points, model.depth_range, step)
            except UserError as error:
                raise UserError(
                    f"step {step}: to go on with {points} points, {error}, in another --out"
                ) from None

    def need_of(
        self, grid: Grid, points: int, depth_range: tuple[float, float], step: int = 0
    ) -> Need:
        """What a training with these points of a grid takes from a step on, seen from the middle of
        the depth range.
        """
        middle = sum(depth_range) / 2
        # footprints grow by 1 / (z^2 cos) nearer by and off the axis: the mean over a cube, to
        # second order
        growth = 1 + (grid.diagonal / middle) ** 2 / 9
        radius = point_radius(self._config.raster, grid.edge, depth_range)
        pixels = radius * self._largest.fx / middle * math.sqrt(growth)
        return self._needed(points, pixels, step)

    def _check(self, need):
        info, name, self.need = self.dev.info, self.dev.name, need
        lower, available = "lower --points or train.crop, or raise --downscale", available_bytes()
        free = math.inf if available is None else max(0, available - self._program)
        budget = self._config.train.memory_gib
        if need.largest > info["max_allocation_bytes"]:
            most = _size(info["max_allocation_bytes"])
            why = f"a buffer of {_size(need.largest)} is more than the {most} that {name} allocates"
            why += " at once"
        elif need.device > info["memory_bytes"]:
            has = _size(info["memory_bytes"])
            why = f"the training needs {_size(need.device)}, {name} has {has}"
        elif need.host > free:
            why = f"the training needs {_size(need.host)} of the host's memory, {_size(free)} are"
            why += " free"
        elif budget and need.device > budget * GIB:
            why = f"--memory {budget:g}: the training needs {_size(need.device)}"
            lower = f"give --memory {math.ceil(need.device / GIB * 100) / 100:g}, {lower}"
        else:
            return
        raise UserError(f"{why}: {lower}, or choose another device (`pp-cl devices`)")

    def _needed(self, points, radius, step):
        """The Need from a step on. radius: of the footprints then, pixels of the largest photograph
        as it is stored.
        """
        begun = sum(step < at for at in refine_steps(self._config.train))
        levels = []
        for n, left, is_averaged in _levels(self._config.train, points, step):
            # of soft points as wide as points are apart, which refining halves
            halved = begun - left if self._config.raster.footprint == "soft" else 0
            levels.append((*self._bytes(n, left, is_averaged, radius / 2**halved), n, left))
        device, _, at_peak, _ = max(levels)
        refined = [n for _, _, n, left in levels if left]
        training = PIECES + REFINING * max(refined, default=0) + self.dev.is_cpu * device
        return Need(
            device,
            at_peak,
            max(largest for _, largest, _, _ in levels),
            self._photographs + max(training, self._reading),
        )

    def _bytes(self, points, left, is_averaged, radius):
        """(bytes on the device, those of the largest buffer) with some refinements left."""
        config, downscale = self._config, self._config.scene.downscale
        raster, train, blocks = config.raster, config.train, sh_blocks(config.points.sh_degree)
        crop_size = _size_of(
            self._largest.downscaled(downscale << left), crop_side(train.crop, left)
        )
        image_size = _size_of(self._largest.downscaled(downscale), 0)
        crop, image = math.prod(crop_size), math.prod(image_size)
        area = math.pi * max(LEAST_RADIUS, radius / downscale) ** 2
        pairs = GROWN * points * min(area, image)
        shown = points if raster.early_stop == 0 else SHOWN * points
        share = min(1.0, CROP_SHARE * crop / image)

        learned = PointCloud.table(1, blocks) | {
            f"state.{name}": row for name, row in PointState.table(1).items()
        }
        point = table_bytes(learned) + VIEW_POINT + NEIGHBOURS * (train.sh_smoothing > 0)
        averages = is_averaged * table_bytes(PointState.ema_table(1))
        # these take turns
        step = share * (pairs * TRAINED_PAIR + shown * TRAINED_FEATURES) + points * averages
        preview = pairs * PAIR + shown * FEATURES + points * averages
        is_end = left == 0 and is_averaged == train.ema
        pruning = pairs * LISTED_PAIR if is_end and train.prune_weight > 0 else 0
        trained, rendered, widest = MAPS[config.network.blocks]
        channels = sum(width / 4**level for level, width in enumerate(config.network.widths))
        maps = 4 * channels * (crop * trained + image * rendered)
        parameters = self._net.all_parameters.nbytes * (COPIES + is_averaged)
        parameters += self._net.work_bytes(crop_size, True)
        parameters += self._net.work_bytes(image_size, False)
        shared = self._net.scratch_bytes(crop_size, True)
        parameters += max(shared, self._net.scratch_bytes(image_size, False))
        photograph = self._photographs // len(self._sizes)
        total = points * point + max(step, preview, pruning) + crop * TRAINED_PIXEL + maps
        total += parameters + photograph
        coefficients = 64 * points * max(block.count for block in blocks)
        largest = max(coefficients, 8 * pairs, 4 * image * config.network.widths[0] * widest)
        return round(total), round(largest)


def _levels(train, points: int, step: int) -> Iterator[tuple[int, int, bool]]:
    """(points, refinements to come, whether averages are kept) of each level of refinement from a
    step on, with its first points, and of the averages at the end. What prunings to come leave is
    an estimate.
    """
    ends, averages = [*refine_steps(train), train.iterations], _averages(train)
    for level, end in enumerate(ends):
        start, left = ends[level - 1] if level else 0, len(ends) - 1 - level
        if end <= step:
            continue
        now = max(start, step)
        yield points, left, averages <= now
        to_come = prunings(train, now, end) / max(1, prunings(train, start, end))
        points = round(points * KEPT_BY_PRUNING**to_come)
        if left:
            points *= 8
        elif now < averages < end:
            yield points, left, True


def _averages(train):
    """The step from which on averages are kept, infinite for never."""
    return ema_start(train.iterations) if train.ema else math.inf


def _size_of(camera: Camera, side: int) -> tuple[int, int]:
    """(height, width) of a crop, in whole multiples of what the network needs; side 0: of the whole
    image.
    """
    height, width = (min(side or size, size) for size in (camera.height, camera.width))
    return height + -height % UNet.multiple, width + -width % UNet.multiple


def _size(size):
    """Bytes in a unit that shows three digits."""
    return f"{size / GIB:.2f} GiB" if size >= GIB else f"{size / MIB:.3g} MiB"


def memory_line(room: Room) -> str:
    """The memory that the last check found to be needed, in words."""
    need, dev = room.need, room.dev
    return (
        f"memory: about {need.device / MIB:.0f} of {dev.info['memory_bytes'] / MIB:.0f} MiB of"
        f" {dev.name} (with {need.points} points), {need.host / MIB:.0f} MiB of the host"
        + (", the device's among them" if dev.is_cpu else "")
    )
