"""Weight and bias gradients of 3x3 convolutions by Winograd's minimal filtering."""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.conv_backward_weights import sum_parts
from pp_cl.layers.tiles import LANES, SIDE, Tiles, checked_tiles
from pp_cl.layers.winograd import WinogradForm, check_size, fits, pair_blocks
from pp_cl.layers.work import COUNTERS, Work

# At most this many input and output channels of the weights at a time: smaller parts transform the
# same tiles more often, larger ones outgrow a core's cache.
CI_PART, CO_PART = 128, 128
# Weights of at most so many channels in times channels out are narrow: their sums, 36 floats each,
# fit a core's cache. Cutting them would transform each tile more than once. The tiles are cut in
# their place, into 2, 4, 8 or 16 parts of LEAST_TILES or more.
NARROW = 64 * 128
LEAST_TILES, MOST_PARTS = 80, 16


def backward_weights_floats(
    dev: Device, form: WinogradForm, weight_shape: tuple
) -> tuple[int, int]:
    """Floats of (Work.scratch, Work.weights) that winograd_backward_weights needs.

    weight_shape: (CO/16, 3, 3, CI, 16).
    """
    blocks, _, _, ci, _ = weight_shape
    ci_part, co_part = min(CI_PART, ci), min(CO_PART, blocks * LANES)
    values = (ci_part + co_part) // LANES * form.weights_tiles
    vectors = form.positions * (values + 3 + ci_part * co_part // LANES) + co_part // LANES
    parts = MOST_PARTS if _is_narrow(ci, blocks * LANES) else 1
    scratch = COUNTERS + dev.info["compute_units"] * vectors * LANES
    return scratch, parts * blocks * (9 * ci + 1) * LANES


def winograd_backward_weights(
    dev: Device,
    form: WinogradForm,
    sources: tuple[Array, ...],
    grad_out: Array,
    *,
    grad_weight: Array,
    grad_bias: Array,
    work: Work,
    tiles: Tiles | None = None,
) -> None:
    """Overwrite grad_weight and grad_bias with the gradients of winograd_forward(sources, ...): see
    conv_backward_weights.conv_backward_weights for the shapes and the tiles.

    work: at least backward_weights_floats. The order of the sums depends on the shapes and the
    number of tiles alone. Raises ValueError when shapes do not fit together.
    """
    _check_shapes(sources, grad_out, grad_weight, grad_bias)
    height, width, co = grad_out.shape
    channels = [source.shape[2] for source in sources]
    needed = backward_weights_floats(dev, form, grad_weight.shape)
    check_size("scratch", work.scratch, needed[0])
    check_size("parts of the gradient", work.weights, needed[1])
    tiles = checked_tiles(dev, tiles, height, width)
    tile_parts = _tile_parts(tiles.number * (SIDE // form.m) ** 2, sum(channels), co)
    ci_part = sum(channels) if tile_parts > 1 else _ci_part(dev, sum(channels), co)
    parts = tile_parts * -(-sum(channels) // ci_part) * -(-co // CO_PART)
    _program(dev, form, co).launch(
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
        partial=work.weights,
        scratch=work.scratch,
    )
    sum_parts(dev, work.weights, grad_weight, grad_bias, parts=tile_parts)


def _check_shapes(sources, grad_out, grad_weight, grad_bias):
    """Raise ValueError when shapes do not fit together."""
    co, (blocks, _, _, ci, _) = grad_out.shape[2], grad_weight.shape
    channels = [source.shape[2] for source in sources]
    found = (sum(channels), co, grad_bias.shape)
    if not fits(*channels, co) or found != (ci, blocks * LANES, (co,)):
        raise ValueError(
            f"Winograd weight gradient of {channels} to {co} channels: weight is"
            f" {grad_weight.shape}, bias {grad_bias.shape}"
        )


def _is_narrow(ci, co):
    return ci <= CI_PART and co <= CO_PART and ci * co <= NARROW


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
    return min(CI_PART, max(1, ci // (LANES * wanted)) * LANES)


def _program(dev, form, co):
    return dev.program(
        "layers/winograd_backward_weights",
        WINO_M=form.m,
        TILES=form.weights_tiles,
        CO_PART=min(CO_PART, co),
        BLOCKS=pair_blocks(co),
    )
