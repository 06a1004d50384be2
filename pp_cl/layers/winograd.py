"""3x3 convolutions by Winograd's minimal filtering F(m x m, 3 x 3), with fewer multiplications than
the direct ones.

m = 2 takes 2.25 times fewer, m = 4 takes 4 times fewer at two or three times the error. Channels
come in multiples of 16. The weights are transformed first (winograd_transform.py).
"""

from dataclasses import dataclass

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.tiles import LANES, SIDE, Tiles, checked_tiles
from pp_cl.layers.work import COUNTERS, Work

# Weights of at most so many channels in times channels out are narrow: transformed they take 2.25
# MiB, about what a core's L2 cache holds, and reading them for fewer tiles at a time costs little.
NARROW = 128 * 128


@dataclass(frozen=True)
class WinogradForm:
    """One of the ways to run these kernels.

    m: side of a tile of outputs, 2 or 4. half: transformed weights are stored in 16 bits. wide,
    narrow: (tiles transformed at a time, tiles multiplied together) by channels, weights_tiles:
    tiles transformed at a time for the gradient of the weights; see blocking.Blocking.
    """

    m: int
    half: bool
    wide: tuple[int, int]
    narrow: tuple[int, int]
    weights_tiles: int

    @property
    def positions(self) -> int:
        """Values of a transformed tile."""
        return (self.m + 2) ** 2

    def tiles_and_group(self, ci: int, co: int) -> tuple[int, int]:
        """`wide` or `narrow`, for a convolution of ci to co channels."""
        return self.narrow if ci * co <= NARROW else self.wide

    def transformed_floats(self, ci: int, co: int) -> int:
        """Floats of the transformed weights of ci to co channels, as cl/layers/winograd.h lays them
        out.
        """
        floats = self.positions * (ci * co + LANES)
        return max(ci, co) + floats // 2 if self.half else floats

    def scratch_floats(self, dev: Device, ci: int, co: int) -> int:
        """Floats of scratch memory of a convolution of ci to co channels, or of its input
        gradient.
        """
        vectors = (ci + co) * self.tiles_and_group(ci, co)[0] + 3 * LANES
        return COUNTERS + dev.info["compute_units"] * self.positions * vectors


def winograd_forward(
    dev: Device,
    form: WinogradForm,
    sources: tuple[Array, ...],
    bias: Array,
    *,
    out: Array,
    relu: bool,
    work: Work,
    tiles: Tiles | None = None,
) -> None:
    """out = convolution of the sources' concatenation + bias, then max(., 0) if relu.

    sources: one or two of (H, W, C1), (H, W, C2); bias: (CO,); out: (H, W, CO); work.weights: from
    winograd_transform.transform_weights; work.scratch: at least form.scratch_floats; tiles: those
    of out to compute, None = all. The result does not depend on the number of compute units.
    Raises ValueError when shapes do not fit together.
    """
    height, width, co = out.shape
    channels = [source.shape[2] for source in sources]
    if not fits(*channels, co) or bias.shape != (co,):
        raise ValueError(
            f"Winograd convolution of {' + '.join(map(str, channels))} to {co} channels, bias"
            f" {bias.shape}: channels come in multiples of {LANES}"
        )
    _check_work(dev, form, work, (sum(channels), co))
    tiles = checked_tiles(dev, tiles, height, width)
    _program(dev, form, sum(channels), co).launch(
        "winograd_forward",
        work_items(dev, form, tiles),
        local=1,
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        transformed=work.weights,
        bias=bias,
        tile_list=tiles.list,
        out=out,
        scratch=work.scratch,
    )


def winograd_backward_input(
    dev: Device,
    form: WinogradForm,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    work: Work,
    tiles: Tiles | None = None,
) -> None:
    """grad_x = gradient of a convolution's input, 0 where mask <= 0.

    grad_out: (H, W, CO); grad_x: (H, W, C); mask: (H, W, C) or None, as in
    conv.conv_backward_input; work.weights: from winograd_transform.transform_flipped_weights;
    work.scratch: at least form.scratch_floats; tiles: those of grad_x to compute, None = all.
    Raises ValueError when shapes do not fit together.
    """
    height, width, c = grad_x.shape
    co = grad_out.shape[2]
    if not fits(c, co):
        raise ValueError(
            f"Winograd input gradient of {c} from {co} channels: channels come in multiples of"
            f" {LANES}"
        )
    _check_work(dev, form, work, (c, co))
    tiles = checked_tiles(dev, tiles, height, width)
    _program(dev, form, co, c).launch(
        "winograd_backward_input",
        work_items(dev, form, tiles),
        local=1,
        c=c,
        co=co,
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=work.weights,
        grad_out=grad_out,
        tile_list=tiles.list,
        grad_x=grad_x,
        scratch=work.scratch,
    )


def fits(*channels: int) -> bool:
    """Whether these numbers of channels are multiples of 16."""
    return all(c and c % LANES == 0 for c in channels)


def work_items(dev: Device, form: WinogradForm, tiles: Tiles) -> int:
    """One work-item per compute unit, at most one per tile of outputs."""
    return min(dev.info["compute_units"], tiles.number * (SIDE // form.m) ** 2)


def pair_blocks(channels: int) -> int:
    """Groups of 16 output channels that are multiplied together."""
    return 1 if channels // LANES % 2 else 2


def check_size(what: str, array: Array, floats: int) -> None:
    """Raise ValueError if an array is too small."""
    if array.size < floats:
        raise ValueError(f"Winograd: {what} of {array.size} floats, needs {floats}")


def _check_work(dev, form, work, channels):
    check_size("transformed weights", work.weights, form.transformed_floats(*channels))
    check_size("scratch", work.scratch, form.scratch_floats(dev, *channels))


def _program(dev, form, channels_in, channels_out):
    tiles, group = form.tiles_and_group(channels_in, channels_out)
    return dev.program(
        "layers/winograd",
        WINO_M=form.m,
        TILES=tiles,
        GROUP=group,
        BLOCKS=pair_blocks(channels_out),
        HALF=int(form.half),
    )
