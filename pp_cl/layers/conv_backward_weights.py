"""Weight and bias gradients of the direct convolutions, and the flipped weights from which their
input gradients are computed.
"""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.form import lanes, row_parts
from pp_cl.layers.blocking import Blocking
from pp_cl.layers.tiles import LANES, Tiles, checked_tiles

# Rows of the image that one work-item sums: few enough to stay in a core's cache, and enough parts
# for all cores.
ROWS_PER_PART = 8
# The partial sums take at most this many floats (64 MiB), or one part if that is larger.
PARTIAL_FLOATS = 1 << 24


def flip_weights(
    dev: Device, weight: Array, first: int, flipped: Array, *, blocking: Blocking
) -> None:
    """flipped = weight with the kernel mirrored and the roles of input and output channels
    exchanged.

    weight: (ceil(CO/16), K, K, CI, 16); flipped: (ceil(C/16), K, K, CO, 16) for the C input
    channels from `first` on; C = CI - first or less, a multiple of 16 unless it reaches CI.
    """
    k, ci = weight.shape[1], weight.shape[3]
    blocks, co = flipped.shape[0], flipped.shape[3]
    _program(dev, blocking, k, ci)[0].launch(
        "conv_flip_weights",
        (co, k * k, blocks),
        c=min(ci - first, blocks * LANES),
        co=co,
        first=first,
        ci=ci,
        weight=weight,
        flipped=flipped,
    )


def partial_floats(height: int, weight_shape: tuple) -> int:
    """Floats of scratch memory that conv_backward_weights needs for an image `height` high."""
    blocks, k, _, ci, _ = weight_shape
    return most_parts(height, weight_shape) * blocks * (k * k * ci + 1) * LANES


def most_parts(height: int, weight_shape: tuple) -> int:
    """Into how many parts the sum over an image `height` high is cut."""
    return _parts(height, weight_shape)[0]


def conv_backward_weights(
    dev: Device,
    sources: tuple[Array, ...],
    grad_out: Array,
    grad_weight: Array,
    *,
    grad_bias: Array,
    partial: Array,
    blocking: Blocking,
    tiles: Tiles | None = None,
) -> None:
    """Overwrite grad_weight and grad_bias with the gradients of conv_forward(sources, ...), given
    dL/dout before the ReLU.

    sources: one or two of (H, W, C1), (H, W, C2); grad_out: (H, W, CO); grad_weight:
    (ceil(CO/16), K, K, C1 + C2, 16); grad_bias: (ceil(CO/16) * 16,); partial: scratch of at least
    partial_floats(H, grad_weight.shape); tiles: those of grad_out to sum, each as often as it
    counts, None = all, once. The order of the sums depends on the shapes alone. Raises ValueError
    when shapes do not fit together.
    """
    height, width, co = grad_out.shape
    blocks, k, _, ci, _ = grad_weight.shape
    check_shapes(sources, grad_out, grad_weight, grad_bias)
    check_scratch(partial, partial_floats(height, grad_weight.shape))
    tiles = checked_tiles(dev, tiles, height, width)
    parts, rows = _parts(height, grad_weight.shape)
    first = 0
    for source in sources:
        c = source.shape[2]
        program, group = _program(dev, blocking, k, c)
        program.launch(
            "conv_backward_weights",
            (c // group * k, blocks, parts),
            local=blocking.work_group,
            multiply_adds=height * width * k**2 * c * co,
            along=2,
            height=height,
            width=width,
            c=c,
            co=co,
            first=first,
            ci=ci,
            rows=rows,
            x=source,
            grad_out=grad_out,
            tile_count=tiles.count,
            partial=partial,
        )
        first += c
    sum_parts(dev, partial, grad_weight, grad_bias, parts=parts)


def sum_parts(
    dev: Device, partial: Array, grad_weight: Array, grad_bias: Array, *, parts: int
) -> None:
    """grad_weight (blocks, K, K, CI, 16) and grad_bias (blocks * 16,) = sums, in order, of the
    parts of an image, partial (parts, blocks, K * K * CI + 1, 16) or longer.
    """
    blocks, k, _, ci, _ = grad_weight.shape
    dev.program("layers/conv_backward_weights", KERNEL_SIZE=k, LANES=lanes(dev)).launch(
        "conv_sum_parts",
        (row_parts(dev) * (k * k * ci + 1), blocks),
        per_block=k * k * ci,
        blocks=blocks,
        parts=parts,
        partial=partial,
        grad_weight=grad_weight,
        grad_bias=grad_bias,
    )


def check_shapes(
    sources: tuple[Array, ...], grad_out: Array, grad_weight: Array, grad_bias: Array
) -> None:
    """Raise ValueError when shapes do not fit together."""
    co, (blocks, _, _, ci, _) = grad_out.shape[2], grad_weight.shape
    channels = [source.shape[2] for source in sources]
    if (sum(channels), -(-co // LANES), grad_bias.shape) != (ci, blocks, (blocks * LANES,)):
        raise ValueError(
            f"weight gradient of {channels} to {co} channels: "
            f"weight is {grad_weight.shape}, bias {grad_bias.shape}"
        )


def check_scratch(partial: Array, needed: int) -> None:
    """Raise ValueError when there is less scratch than needed."""
    if partial.size < needed:
        raise ValueError(f"weight gradient: scratch has {partial.size} floats, needs {needed}")


def _parts(height, weight_shape):
    """(parts, rows of each) of the sum over an image."""
    blocks, k, _, ci, _ = weight_shape
    limit = max(1, PARTIAL_FLOATS // (blocks * (k * k * ci + 1) * LANES))
    rows = max(ROWS_PER_PART, -(-height // limit))
    return -(-height // rows), rows


def _program(dev, blocking, k, channels):
    """(program, input channels of one work-item): a divisor of the channels whose sums, k for each
    channel, fit the registers.
    """
    group = next(
        n for n in (16, 8, 4, 2, 1) if n * k <= blocking.accumulators and channels % n == 0
    )
    return dev.program("layers/conv_backward_weights", KERNEL_SIZE=k, CI_GROUP=group), group
