"""Weight and bias gradients of convolutions, and the flipped weights their input gradients are made
with.
"""

from pp_cl.layers.conv import LANES
from pp_cl.layers.tiles import checked_tiles

# Rows of the image that one work-item adds up: few enough to stay in a core's cache, and enough
# parts for all cores.
ROWS_PER_PART = 8
# The parts of all sums together take at most so many floats (64 MiB), or one part if that is
# larger.
PARTIAL_FLOATS = 1 << 24


def flip_weights(dev, weight, first, flipped):
    """flipped = weight with the kernel mirrored and the roles of input and output channels
    exchanged.

    weight: (ceil(CO/16), K, K, CI, 16); flipped: (ceil(C/16), K, K, CO, 16) for the C input
    channels from `first` on; C = CI - first or less, a multiple of 16 unless it reaches CI.
    """
    k, ci = weight.shape[1], weight.shape[3]
    blocks, co = flipped.shape[0], flipped.shape[3]
    dev.program("layers/conv_backward_weights", K=k, CI_TILE=_ci_tile(dev, k, ci)).launch(
        "conv_flip_weights",
        (co, k * k, blocks),
        c=min(ci - first, blocks * LANES),
        co=co,
        first=first,
        ci=ci,
        weight=weight,
        flipped=flipped,
    )


def partial_floats(height, weight_shape):
    """Floats of scratch memory that weight_gradient needs for an image `height` high."""
    blocks, k, _, ci, _ = weight_shape
    return _parts(height, weight_shape)[0] * blocks * (k * k * ci + 1) * LANES


def weight_gradient(dev, x, grad_out, grad_weight, grad_bias, partial, x2=None, tiles=None):
    """Overwrite grad_weight and grad_bias with the gradients of conv_forward(x, ..., x2), given
    dL/dout before the ReLU.

    x: (H, W, C1), x2: None or (H, W, C2), grad_out: (H, W, CO); grad_weight: (ceil(CO/16), K, K, C1
    + C2, 16); grad_bias: (ceil(CO/16) * 16,); partial: scratch of at least partial_floats(H,
    grad_weight.shape). tiles: tiles.Tiles of grad_out that are read, each as often as it counts,
    None = all, once. The sums run in an order that depends on the shapes alone. Raises ValueError
    when shapes do not fit together.
    """
    height, width, co = grad_out.shape
    blocks, k, _, ci, _ = grad_weight.shape
    sources = [x] if x2 is None else [x, x2]
    if (
        sum(s.shape[2] for s in sources) != ci
        or blocks != -(-co // LANES)
        or grad_bias.shape != (blocks * LANES,)
    ):
        raise ValueError(
            f"weight gradient of {[s.shape for s in sources]} to {co} channels: "
            f"weight is {grad_weight.shape}, bias {grad_bias.shape}"
        )
    needed = partial_floats(height, grad_weight.shape)
    if partial.size < needed:
        raise ValueError(f"weight gradient: scratch has {partial.size} floats, needs {needed}")
    parts, rows = _parts(height, grad_weight.shape)
    first = 0
    for source in sources:
        c = source.shape[2]
        tile = _ci_tile(dev, k, c)
        program = dev.program("layers/conv_backward_weights", K=k, CI_TILE=tile)
        program.launch(
            "conv_backward_weights",
            (c // tile * k, blocks, parts),
            local=(1, 1, 1) if dev.is_cpu else None,
            height=height,
            width=width,
            c=c,
            co=co,
            first=first,
            ci=ci,
            rows=rows,
            x=source,
            grad_out=grad_out,
            tile_count=checked_tiles(dev, tiles, height, width).count,
            partial=partial,
        )
        first += c
    program.launch(
        "conv_sum_parts",
        (k * k * ci + 1, blocks),
        per_block=k * k * ci,
        blocks=blocks,
        parts=parts,
        partial=partial,
        grad_weight=grad_weight,
        grad_bias=grad_bias,
    )


def _parts(height, weight_shape):
    """(parts, rows of each) of the sum over an image."""
    blocks, k, _, ci, _ = weight_shape
    limit = max(1, PARTIAL_FLOATS // (blocks * (k * k * ci + 1) * LANES))
    rows = max(ROWS_PER_PART, -(-height // limit))
    return -(-height // rows), rows


def _ci_tile(dev, k, channels):
    """Input channels of one work-item: a divisor of the channels whose k * tile accumulators fit
    the registers.

    A CPU core has 32 vector registers; a GPU's work-item has about 255 scalar ones, and a vector
    takes 16 of them.
    """
    accumulators = 24 if dev.is_cpu else 6
    return next(t for t in (16, 8, 4, 2, 1) if t * k <= accumulators and channels % t == 0)
