"""Weight and bias gradients of 3x3 convolutions by Winograd's minimal filtering."""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.layers.tiles import LANES, Tiles, checked_tiles
from pp_cl.layers.winograd import WinogradForm, check_size, fits, pair_blocks

# At most this many input and output channels of the weights at a time: smaller parts transform the
# same tiles more often, larger ones outgrow a core's cache.
CI_PART, CO_PART = 128, 128


def backward_weights_floats(dev: Device, form: WinogradForm) -> int:
    """Floats of scratch memory that winograd_backward_weights needs."""
    values = (CI_PART + CO_PART) // LANES * form.weights_tiles
    vectors = form.positions * (values + 3 + CI_PART * CO_PART // LANES) + CO_PART // LANES
    return dev.info["compute_units"] * vectors * LANES


def winograd_backward_weights(
    dev: Device,
    form: WinogradForm,
    sources: tuple[Array, ...],
    grad_out: Array,
    *,
    grad_weight: Array,
    grad_bias: Array,
    scratch: Array,
    tiles: Tiles | None = None,
) -> None:
    """Overwrite grad_weight and grad_bias with the gradients of winograd_forward(sources, ...): see
    conv_backward_weights.conv_backward_weights for the shapes and the tiles.

    scratch: at least backward_weights_floats. The order of the sums depends on the shapes alone.
    Raises ValueError when shapes do not fit together.
    """
    _check_shapes(sources, grad_out, grad_weight, grad_bias)
    height, width, co = grad_out.shape
    check_size("scratch", scratch, backward_weights_floats(dev, form))
    program = dev.program(
        "layers/winograd_backward_weights",
        WINO_M=form.m,
        TILES=form.weights_tiles,
        CO_PART=CO_PART,
        BLOCKS=pair_blocks(co),
    )
    tiles, first = checked_tiles(dev, tiles, height, width), 0
    for source in sources:
        c = source.shape[2]
        ci_part = _ci_part(dev, c, co)
        items = min(dev.info["compute_units"], -(-c // ci_part) * -(-co // CO_PART))
        program.launch(
            "winograd_backward_weights",
            items,
            local=1,
            c=c,
            co=co,
            first=first,
            ci=grad_weight.shape[3],
            ci_part=ci_part,
            x=source,
            grad_out=grad_out,
            tile_list=tiles.list,
            tile_count=tiles.count,
            grad_weight=grad_weight,
            grad_bias=grad_bias,
            scratch=scratch,
        )
        first += c


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


def _ci_part(dev, c, co):
    """Input channels of one part: few enough that every compute unit gets a part."""
    wanted = -(-dev.info["compute_units"] // -(-co // CO_PART))
    return min(CI_PART, max(1, c // (LANES * wanted)) * LANES)
