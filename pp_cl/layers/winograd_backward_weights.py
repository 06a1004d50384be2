"""Weight and bias gradients of 3x3 convolutions by Winograd's minimal filtering."""

from pp_cl.layers.conv import LANES
from pp_cl.layers.tiles import checked_tiles
from pp_cl.layers.winograd import fits, pair_blocks, positions

# Tiles of one round and, at most, input and output channels of one part of the weights: smaller
# parts transform the same tiles more often, larger ones outgrow a core's cache. Device.tile_shapes
# may have other TILES.
TILES, CI_PART, CO_PART = 32, 128, 128


def gradient_scratch_floats(dev, m):
    """Floats of scratch memory that winograd_weight_gradient needs."""
    values = (CI_PART + CO_PART) // LANES * _tile_shape(dev)
    vectors = positions(m) * (values + 3 + CI_PART * CO_PART // LANES) + CO_PART // LANES
    return dev.info["compute_units"] * vectors * LANES


def winograd_weight_gradient(
    dev, m, x, grad_out, grad_weight, grad_bias, scratch, x2=None, tiles=None
):
    """Overwrite grad_weight and grad_bias with the gradients of winograd_forward(..., x, ..., x2):
    see conv_weights.weight_gradient for the shapes and the tiles.

    scratch: at least gradient_scratch_floats. The sums run in an order that depends on the shapes
    alone. Raises ValueError when shapes do not fit together.
    """
    height, width, co = grad_out.shape
    blocks, _, _, ci, _ = grad_weight.shape
    sources = [x] if x2 is None else [x, x2]
    channels = [s.shape[2] for s in sources]
    if (
        not fits(*channels, co)
        or sum(channels) != ci
        or blocks != co // LANES
        or grad_bias.shape != (co,)
    ):
        raise ValueError(
            f"Winograd weight gradient of {channels} to {co} channels: weight is"
            f" {grad_weight.shape}, bias {grad_bias.shape}"
        )
    if scratch.size < gradient_scratch_floats(dev, m):
        raise ValueError(
            f"Winograd weight gradient: scratch has {scratch.size} floats, "
            f"needs {gradient_scratch_floats(dev, m)}"
        )
    program = dev.program(
        "layers/winograd_backward_weights",
        M=m,
        TILES=_tile_shape(dev),
        CO_PART=CO_PART,
        BLOCKS=pair_blocks(blocks),
    )
    tiles = checked_tiles(dev, tiles, height, width)
    first = 0
    for source, c in zip(sources, channels, strict=True):
        ci_part = _ci_part(dev, c, co)
        items = min(dev.info["compute_units"], -(-c // ci_part) * -(-co // CO_PART))
        program.launch(
            "winograd_backward_weights",
            items,
            local=1,
            c=c,
            co=co,
            first=first,
            ci=ci,
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


def _tile_shape(dev):
    return dev.tile_shapes.get("winograd_weights") or TILES


def _ci_part(dev, c, co):
    """Input channels of one part: as many as leave every compute unit a part."""
    wanted = -(-dev.info["compute_units"] // -(-co // CO_PART))
    return min(CI_PART, max(1, c // (LANES * wanted)) * LANES)
