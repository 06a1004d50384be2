"""3x3 convolutions by Winograd's minimal filtering F(4 x 4, 3 x 3), with 4 times fewer
multiplications than the direct ones, at two or three times the error. Channels must be multiples of
16. Launches winograd.cl and winograd_backward.cl; results do not depend on the number of compute
units.
"""

from collections.abc import Iterable, Sequence

from pyopencl.array import Array

from pp_cl.engine.layers.conv import Conv, ConvShape, mask_bits
from pp_cl.engine.layers.tiles import MAP_TILE, VECTOR, Tiles

POSITIONS = (MAP_TILE + 2) ** 2  # values of a transformed tile
# Weights are narrow if input channels times output channels are at most this: transformed they take
# 2.25 MiB, about a core's L2 cache, and reading them for fewer tiles at a time costs little.
NARROW = 128 * 128
# The most input and output channels in a part of the gradient of the weights: smaller parts
# transform the same tiles more often, larger ones outgrow a core's cache.
CI_PART, CO_PART = 128, 128
# In these gradients, weights are narrow if input times output channels are at most this: their
# sums, 36 floats each, fit a core's cache. Cutting them would transform each tile more than once;
# the tiles are cut instead, into 2, 4, 8 or 16 parts of LEAST_TILES or more.
NARROW_SUMS = 64 * 128
LEAST_TILES, MOST_PARTS = 80, 16
COUNTERS = VECTOR  # floats at the front of the scratch, 0 between kernels (cl/layers/winograd.h)


def fits(*channels: int) -> bool:
    """Whether these numbers of channels are multiples of 16."""
    return all(c and c % VECTOR == 0 for c in channels)


def forward(conv: Conv, sources: Sequence[Array], out: Array, *, relu: bool, tiles: Tiles) -> None:
    """See conv_direct."""
    shape = conv.shape
    tiles.check(shape.size)
    conv.dev.program("layers/winograd", **_defines(conv, shape.co)).launch(
        "winograd_forward",
        min(conv.dev.info["compute_units"], tiles.number),
        1,
        c1=shape.sources[0],
        c2=sum(shape.sources[1:]),
        co=shape.co,
        relu=relu,
        x=sources[0],
        x2=sources[-1],
        weight=conv.work,
        bias=conv.bias,
        tile_list=tiles.list,
        out=out,
        scratch=_scratch(conv),
    )


def backward(
    conv: Conv,
    sources: Sequence[Array],
    grad_out: Array,
    grads: Sequence[Array],
    *,
    masks: Sequence[bool],
    tiles: Tiles,
    grad_tiles: Tiles,
) -> int:
    """See conv_direct."""
    ci, co, units = conv.shape.ci, conv.shape.co, conv.dev.info["compute_units"]
    for of_map in (tiles, grad_tiles):
        of_map.check(conv.shape.size)
    tile_parts = _tile_parts(tiles.number, ci, co)
    ci_part = ci if tile_parts > 1 else _ci_part(units, ci, co)
    parts = tile_parts * -(-ci // ci_part) * -(-co // CO_PART)
    conv.dev.program(
        "layers/winograd_backward",
        SUM_TILES=conv.blocking.winograd_weights,
        SUM_BLOCKS=_groups(conv, co),
        CO_PART=min(CO_PART, co),
        **_defines(conv, ci),
    ).launch(
        "winograd_backward",
        min(units, max(parts, grad_tiles.number)),
        1,
        c1=conv.shape.sources[0],
        c2=sum(conv.shape.sources[1:]),
        co=co,
        masked=mask_bits(masks),
        ci_part=ci_part,
        tile_parts=tile_parts,
        x=sources[0],
        x2=sources[-1],
        flipped=conv.work,
        grad_out=grad_out,
        tile_list=tiles.list,
        tile_count=tiles.count,
        grad_list=grad_tiles.list,
        partial=conv.partial,
        grad_x=grads[0],
        grad_x2=grads[-1],
        scratch=_scratch(conv),
    )
    return tile_parts


def parts_of(shape: ConvShape) -> int:
    """The most parts into which the sum over an image for the gradient of weights is cut."""
    return MOST_PARTS if _is_narrow(shape.ci, shape.co) else 1


def transformed_shape(shape: ConvShape) -> tuple[int]:
    """The shape of the transformed weights, laid out as in cl/layers/winograd.h."""
    return (POSITIONS * (shape.ci * shape.co + VECTOR),)


def reserve_scratch(convs: Iterable[Conv]) -> None:
    """Allocate the scratch of all these convolutions at once, before launches hold it."""
    transformed = [conv for conv in convs if conv.variant == "winograd"]
    if transformed:
        _scratch(max(transformed, key=scratch_floats))


def scratch_floats(conv: Conv) -> int:
    """Floats in the scratch that all convolutions share: a slice for each compute unit."""
    ci, co = conv.shape.ci, conv.shape.co
    vectors = POSITIONS * ((ci + co) // VECTOR * _at_once(conv)[0] + 3)
    if conv.shape.direction == "backward":
        ci_part, co_part = min(CI_PART, ci), min(CO_PART, co)
        values = (ci_part + co_part) // VECTOR * conv.blocking.winograd_weights
        sums = POSITIONS * (values + 3 + ci_part * co_part // VECTOR) + co_part // VECTOR
        vectors = max(vectors, sums)
    return COUNTERS + conv.dev.info["compute_units"] * vectors * VECTOR


def _scratch(conv: Conv) -> Array:
    return conv.dev.scratch(
        "Winograd: slices of the compute units", scratch_floats(conv), zeros=COUNTERS
    )


def _defines(conv, channels):
    """The defines of a program whose result has this many channels."""
    at_once, together = _at_once(conv)
    return {"TILES": at_once, "TOGETHER": together, "BLOCKS": _groups(conv, channels)}


def _at_once(conv):
    """(tiles transformed at a time, tiles multiplied together)."""
    narrow = conv.shape.ci * conv.shape.co <= NARROW
    return conv.blocking.winograd_narrow if narrow else conv.blocking.winograd


def _groups(conv, channels):
    """Groups of 16 output channels that are multiplied together."""
    groups = conv.blocking.winograd_groups
    return 1 if channels // VECTOR % groups else groups


def _is_narrow(ci, co):
    return ci <= CI_PART and co <= CO_PART and ci * co <= NARROW_SUMS


def _tile_parts(number, ci, co):
    """The parts to cut `number` tiles into: a power of two, which most numbers of compute units
    share evenly.
    """
    parts = 1
    while _is_narrow(ci, co) and parts < MOST_PARTS and number >= 2 * parts * LEAST_TILES:
        parts *= 2
    return parts


def _ci_part(units, ci, co):
    """Input channels of one part if the tiles are not cut: few enough that every compute unit gets
    a part.
    """
    wanted = -(-units // -(-co // CO_PART))
    return min(CI_PART, max(1, ci // (VECTOR * wanted)) * VECTOR)
