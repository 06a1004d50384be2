"""3x3 convolutions by Winograd's minimal filtering F(m x m, 3 x 3): variants of conv.py's with
fewer multiplications.

m = 2 takes 2.25 times fewer than the direct variant, m = 4 takes 4 times fewer at two or three
times the error. Channels come in multiples of 16. winograd_filter.py makes ready the weights that
any number of convolutions then use; `half` says that they are stored in 16 bits.
"""

from pp_cl.layers.conv import LANES
from pp_cl.layers.tiles import SIDE, checked_tiles

# As shipped; Device.tile_shapes["winograd"] has others where the device was tuned. Tiles
# transformed and multiplied at a time. More of them use the weights better, fewer leave more room
# in the caches.
TILES = 64
# Tiles whose sums are held in registers together, a divisor of TILES: with 2 x 16 channels, 16 of
# AVX-512's 32 vectors.
GROUP = 8


def fits(*channels):
    """Whether Winograd's variants can take these numbers of channels."""
    return all(c and c % LANES == 0 for c in channels)


def positions(m):
    """Values of a transformed tile."""
    return (m + 2) ** 2


def transformed_floats(m, ci, co, half=False):
    """Floats of the transformed weights, as cl/layers/winograd.h lays them out, of ci to co
    channels or the other way round.
    """
    floats = positions(m) * (ci * co + LANES)
    return max(ci, co) + floats // 2 if half else floats


def scratch_floats(dev, m, ci, co):
    """Floats of scratch memory of a convolution of ci to co channels or, the other way round, its
    input gradient.
    """
    return dev.info["compute_units"] * positions(m) * ((ci + co) * _tile_shape(dev)[0] + 3 * LANES)


def winograd_forward(
    dev, m, x, transformed, bias, out, relu, scratch, x2=None, half=False, tiles=None
):
    """out = convolution of [x, x2] + bias, then max(., 0) if relu: conv.conv_forward by
    winograd_filter.transform_weights.

    x: (H, W, C1), x2: None or (H, W, C2), bias: (CO,), out: (H, W, CO); scratch: at least
    scratch_floats; tiles: tiles.Tiles of out that are written, None = all. The result does not
    depend on the number of compute units. Raises ValueError when shapes do not fit together.
    """
    height, width, co = out.shape
    c1, c2 = x.shape[2], 0 if x2 is None else x2.shape[2]
    if not fits(c1, co) or c2 % LANES or bias.shape != (co,):
        raise ValueError(
            f"Winograd convolution of {c1} + {c2} to {co} channels, bias {bias.shape}: "
            f"channels come in multiples of {LANES}"
        )
    check_size("transformed weights", transformed, transformed_floats(m, c1 + c2, co, half))
    check_size("scratch", scratch, scratch_floats(dev, m, c1 + c2, co))
    tiles = checked_tiles(dev, tiles, height, width)
    _program(dev, m, co // LANES, half).launch(
        "winograd_forward",
        work_items(dev, m, tiles),
        local=1,
        c1=c1,
        c2=c2,
        co=co,
        relu=relu,
        x=x,
        x2=x if x2 is None else x2,
        transformed=transformed,
        bias=bias,
        tile_list=tiles.list,
        out=out,
        scratch=scratch,
    )


def winograd_backward_input(
    dev, m, x, transformed, grad_out, grad_x, masked, scratch, half=False, tiles=None
):
    """grad_x = gradient of the convolution's input: conv.conv_backward_input by
    winograd_filter.transform_flipped_weights.

    x, grad_x: (H, W, C), grad_out: (H, W, CO); scratch: at least scratch_floats. x is read only
    where masked. tiles: tiles.Tiles of grad_x that are written, None = all. Raises ValueError when
    shapes do not fit together.
    """
    height, width, c = grad_x.shape
    co = grad_out.shape[2]
    if not fits(c, co):
        raise ValueError(
            f"Winograd input gradient of {c} from {co} channels: channels come in multiples of"
            f" {LANES}"
        )
    check_size("transformed weights", transformed, transformed_floats(m, c, co, half))
    check_size("scratch", scratch, scratch_floats(dev, m, c, co))
    tiles = checked_tiles(dev, tiles, height, width)
    _program(dev, m, c // LANES, half).launch(
        "winograd_backward_input",
        work_items(dev, m, tiles),
        local=1,
        c=c,
        co=co,
        masked=masked,
        x=x,
        flipped=transformed,
        grad_out=grad_out,
        tile_list=tiles.list,
        grad_x=grad_x,
        scratch=scratch,
    )


def work_items(dev, m, tiles):
    """One a compute unit, but none without tiles."""
    return min(dev.info["compute_units"], tiles.number * (SIDE // m) ** 2)


def pair_blocks(blocks):
    """Groups of 16 output channels that are multiplied together."""
    return 1 if blocks % 2 else 2


def check_size(what, array, floats):
    """Raise ValueError if an array is too small."""
    if array.size < floats:
        raise ValueError(f"Winograd: {what} of {array.size} floats, needs {floats}")


def _program(dev, m, blocks, half):
    tiles, group = _tile_shape(dev)
    return dev.program(
        "layers/winograd", M=m, TILES=tiles, GROUP=group, BLOCKS=pair_blocks(blocks), HALF=int(half)
    )


def _tile_shape(dev):
    return dev.tile_shapes.get("winograd") or (TILES, GROUP)
