"""3x3 convolutions by Winograd's minimal filtering F(4 x 4, 3 x 3): 4 times fewer multiplications
than the direct ones, at two or three times the error. Channels come in multiples of 16.
"""

from collections.abc import Sequence

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.conv_direct import (
    Blocking,
    ConvShape,
    Direction,
    Layout,
    check_shape,
    parts_shape,
)
from pp_cl.layers.tiles import SIDE, VECTOR, Tiles, checked_tiles

POSITIONS = (SIDE + 2) ** 2  # values of a transformed tile
# Weights of at most so many channels in times channels out are narrow: transformed they take 2.25
# MiB, about what a core's L2 cache holds, and reading them for fewer tiles at a time costs little.
NARROW = 128 * 128
# At most this many input and output channels of the gradient of the weights at a time: smaller
# parts transform the same tiles more often, larger ones outgrow a core's cache.
CI_PART, CO_PART = 128, 128
# In these gradients, weights of at most so many channels in times channels out are narrow: their
# sums, 36 floats each, fit a core's cache. Cutting them would transform each tile more than once.
# The tiles are cut in their place, into 2, 4, 8 or 16 parts of LEAST_TILES or more.
NARROW_SUMS = 64 * 128
LEAST_TILES, MOST_PARTS = 80, 16
SLICES = "Winograd: slices of the compute units"  # of Device.scratch()
COUNTERS = VECTOR  # floats at the front of SLICES, 0 between kernels (cl/layers/winograd.h)


def fits(*channels: int) -> bool:
    """Whether these numbers of channels are multiples of 16."""
    return all(c and c % VECTOR == 0 for c in channels)


def work_shape(shape: ConvShape) -> tuple[int, ...]:
    """See conv_direct.work_shape. Transformed weights are as cl/layers/winograd.h lays them out."""
    if shape.direction is Direction.BACKWARD_WEIGHTS:
        most = MOST_PARTS if _is_narrow(shape.ci, shape.co) else 1
        return parts_shape(most, 3, shape.ci, shape.co)
    return (_transformed_floats(shape.ci, shape.co),)


def scratch_floats(dev: Device, blocking: Blocking, shape: ConvShape) -> int:
    """See conv_direct.scratch_floats."""
    is_of_weights = shape.direction is Direction.BACKWARD_WEIGHTS
    return (_gradient_slices if is_of_weights else _slices)(dev, blocking, shape.ci, shape.co)


def lay_out(dev: Device, weights: Array, jobs: Sequence[Layout], laid_out: Array) -> None:
    """Transform weights in one launch, see conv_direct.lay_out."""
    rows, n = [], 0
    for shape, start, target in jobs:
        _check_channels(*shape.sources, shape.co)
        flipped = shape.direction is Direction.BACKWARD_INPUT
        channels, co = (shape.co, shape.ci) if flipped else (shape.ci, shape.co)
        ci, place = sum(shape.sources), target // VECTOR
        rows.append((n, channels, co // VECTOR, start, place, shape.first, ci, int(flipped)))
        n += channels * co // VECTOR
    dev.program("layers/winograd_transform").launch(
        "winograd_transform",
        n,
        local=VECTOR,
        n=n,
        rows=len(rows),
        table=dev.constant(rows),
        weights=weights,
        transformed=laid_out,
    )


def forward(
    dev: Device,
    blocking: Blocking,
    sources: tuple[Array, ...],
    weights: Array,
    bias: Array,
    out: Array,
    *,
    relu: bool,
    tiles: Tiles | None = None,
) -> None:
    """See conv_direct.forward. The result does not depend on the number of compute units."""
    height, width, co = out.shape
    channels = [source.shape[2] for source in sources]
    _check_channels(*channels, co)
    check_shape(channels, co, weights, (_transformed_floats(sum(channels), co),), bias)
    tiles = checked_tiles(dev, tiles, height, width)
    _program(dev, blocking, sum(channels), co).launch(
        "winograd_forward",
        min(dev.info["compute_units"], tiles.number),
        local=1,
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        transformed=weights,
        bias=bias,
        tile_list=tiles.list,
        out=out,
        scratch=dev.scratch(SLICES, _slices(dev, blocking, sum(channels), co), zeros=COUNTERS),
    )


def backward_input(
    dev: Device,
    blocking: Blocking,
    weights: Array,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    tiles: Tiles | None = None,
) -> None:
    """See conv_direct.backward_input."""
    height, width, c = grad_x.shape
    co = grad_out.shape[2]
    _check_channels(c, co)
    check_shape([c], co, weights, (_transformed_floats(c, co),))
    tiles = checked_tiles(dev, tiles, height, width)
    _program(dev, blocking, co, c).launch(
        "winograd_backward_input",
        min(dev.info["compute_units"], tiles.number),
        local=1,
        c=c,
        co=co,
        masked=mask is not None,
        x=grad_x if mask is None else mask,
        flipped=weights,
        grad_out=grad_out,
        tile_list=tiles.list,
        grad_x=grad_x,
        scratch=dev.scratch(SLICES, _slices(dev, blocking, co, c), zeros=COUNTERS),
    )


def backward_weights(
    dev: Device,
    blocking: Blocking,
    sources: tuple[Array, ...],
    grad_out: Array,
    partial: Array,
    *,
    tiles: Tiles | None = None,
) -> int:
    """See conv_direct.backward_weights. The order of the sums depends on the shapes and the number
    of tiles alone.
    """
    height, width, co = grad_out.shape
    channels = [source.shape[2] for source in sources]
    _check_channels(*channels, co)
    ci = sum(channels)
    most = MOST_PARTS if _is_narrow(ci, co) else 1
    check_shape(channels, co, partial, parts_shape(most, 3, ci, co))
    tiles = checked_tiles(dev, tiles, height, width)
    tile_parts = _tile_parts(tiles.number, ci, co)
    ci_part = ci if tile_parts > 1 else _ci_part(dev, ci, co)
    parts = tile_parts * -(-ci // ci_part) * -(-co // CO_PART)
    dev.program(
        "layers/winograd_backward_weights",
        TILES=blocking.winograd_weights,
        CO_PART=min(CO_PART, co),
        BLOCKS=_groups(blocking, co),
    ).launch(
        "winograd_backward_weights",
        min(dev.info["compute_units"], parts),
        local=1,
        c1=channels[0],
        c2=sum(channels[1:]),
        co=co,
        ci_part=ci_part,
        tile_parts=tile_parts,
        x=sources[0],
        x2=sources[-1],
        grad_out=grad_out,
        tile_list=tiles.list,
        tile_count=tiles.count,
        partial=partial,
        scratch=dev.scratch(SLICES, _gradient_slices(dev, blocking, ci, co), zeros=COUNTERS),
    )
    return tile_parts


def _transformed_floats(ci, co):
    """One vector more between two positions keeps these apart in the sets of a cache."""
    return POSITIONS * (ci * co + VECTOR)


def _check_channels(*channels):
    if not fits(*channels):
        raise ValueError(
            f"Winograd convolution of {channels} channels: they come in multiples of 16"
        )


def _tiles_at_once(blocking, ci, co):
    """Tiles (transformed, multiplied together) at a time."""
    return blocking.winograd_narrow if ci * co <= NARROW else blocking.winograd


def _program(dev, blocking, ci, co):
    tiles, together = _tiles_at_once(blocking, ci, co)
    return dev.program(
        "layers/winograd", TILES=tiles, TOGETHER=together, BLOCKS=_groups(blocking, co)
    )


def _groups(blocking, channels):
    """Groups of 16 output channels that are multiplied together."""
    groups = blocking.winograd_groups
    return 1 if channels // VECTOR % groups else groups


def _slices(dev, blocking, ci, co):
    """Floats of SLICES for a convolution of ci to co channels, or for its input gradient."""
    vectors = (ci + co) * _tiles_at_once(blocking, ci, co)[0] + 3 * VECTOR
    return COUNTERS + dev.info["compute_units"] * POSITIONS * vectors


def _gradient_slices(dev, blocking, ci, co):
    """Floats of SLICES for backward_weights()."""
    ci_part, co_part = min(CI_PART, ci), min(CO_PART, co)
    values = (ci_part + co_part) // VECTOR * blocking.winograd_weights
    vectors = POSITIONS * (values + 3 + ci_part * co_part // VECTOR) + co_part // VECTOR
    return COUNTERS + dev.info["compute_units"] * vectors * VECTOR


def _is_narrow(ci, co):
    return ci <= CI_PART and co <= CO_PART and ci * co <= NARROW_SUMS


def _tile_parts(number, ci, co):
    """Parts of `number` tiles: a power of two, which most numbers of compute units share evenly."""
    parts = 1
    while _is_narrow(ci, co) and parts < MOST_PARTS and number >= 2 * parts * LEAST_TILES:
        parts *= 2
    return parts


def _ci_part(dev, ci, co):
    """Input channels of one part, where the tiles are not cut: few enough that every compute unit
    gets a part.
    """
    wanted = -(-dev.info["compute_units"] // -(-co // CO_PART))
    return min(CI_PART, max(1, ci // (VECTOR * wanted)) * VECTOR)
