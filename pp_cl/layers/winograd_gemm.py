"""3x3 convolutions by Winograd's minimal filtering F(m x m, 3 x 3) for GPUs: many tiles at a time
are multiplied as matrices, through local memory.

The gradient of an input is the convolution with flipped weights. Channels come in multiples of 16.
"""

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.device.launch import Program
from pp_cl.layers.conv_local import quads, runs
from pp_cl.layers.tiles import SIDE, Tiles, checked_tiles
from pp_cl.layers.winograd import check_size, fits
from pp_cl.layers.work import COUNTERS, Work

# Work-items of a group that are tried, until a device runs so many: more share what they load.
GROUPS = (128, 64, 32)
ITEM_SUMS = 8 * 8  # of a work-item, tiles times channels
# Bytes of transformed inputs and products at a time: half of the last cache, through which weights
# and images pass as well, within these bounds. Drivers report no cache, or one of a compute unit.
LEAST_BYTES, MOST_BYTES = 2**23, 2**25


def positions(m: int) -> int:
    """Values of a transformed tile."""
    return (m + 2) ** 2


def transformed_floats(m: int, ci: int, co: int) -> int:
    """Floats of the transformed weights of ci to co channels."""
    return positions(m) * ci * co


def tiles_at_a_time(dev: Device, m: int, ci: int, co: int) -> int:
    """Tiles of m x m outputs that are transformed, multiplied and transformed back at a time: as
    many as a cache holds, in whole work-groups.
    """
    cache = min(max(LEAST_BYTES, dev.info["cache_bytes"] // 2), MOST_BYTES)
    group = _group_tiles(co, GROUPS[0])
    return max(1, cache // (4 * positions(m) * (ci + co)) // group) * group


def scratch_floats(dev: Device, m: int, ci: int, co: int) -> int:
    """Floats of Work.scratch of a convolution of ci to co channels."""
    return COUNTERS + tiles_at_a_time(dev, m, ci, co) * positions(m) * (ci + co)


def winograd_gemm_weights(
    dev: Device, m: int, weight: Array, transformed: Array, *, flipped: range | None = None
) -> None:
    """Fill transformed, of at least transformed_floats(), from weight (CO/16, 3, 3, CI, 16).

    flipped: the input channels that a gradient is for, None = for the forward pass. Raises
    ValueError when transformed is too small, and for channels that are no multiples of 16.
    """
    blocks, _, _, channels, _ = weight.shape
    ci, co = channels, blocks * 16
    if flipped is not None:
        ci, co = co, len(flipped)
        if flipped.stop > channels:
            raise ValueError(f"Winograd input gradient of {flipped} of {channels} channels")
    _check_channels(ci, co)
    check_size("transformed weights", transformed, transformed_floats(m, ci, co))
    _program(dev, m, co)[0].launch(
        "winograd_gemm_weights",
        (co, ci),
        ci=ci,
        co=co,
        flipped=flipped is not None,
        first=flipped.start if flipped else 0,
        channels=channels,
        weight=weight,
        transformed=transformed,
    )


def winograd_gemm_forward(
    dev: Device,
    m: int,
    sources: tuple[Array, ...],
    bias: Array,
    *,
    out: Array,
    relu: bool,
    work: Work,
    tiles: Tiles | None = None,
) -> None:
    """As winograd.winograd_forward, with weights by winograd_gemm_weights() and scratch of
    scratch_floats().
    """
    if bias.shape != out.shape[2:]:
        raise ValueError(f"Winograd convolution to {out.shape[2]} channels: bias {bias.shape}")
    given = {"biased": True, "relu": relu, "masked": False, "bias": bias, "mask": out, "out": out}
    _convolve(dev, m, sources, work=work, tiles=tiles, outputs=given)


def winograd_gemm_backward_input(
    dev: Device,
    m: int,
    grad_out: Array,
    grad_x: Array,
    *,
    mask: Array | None,
    work: Work,
    tiles: Tiles | None = None,
) -> None:
    """As winograd.winograd_backward_input, with flipped weights by winograd_gemm_weights() and
    scratch of scratch_floats().
    """
    given = {"biased": False, "relu": False, "masked": mask is not None, "bias": work.weights}
    given |= {"mask": grad_x if mask is None else mask, "out": grad_x}
    _convolve(dev, m, (grad_out,), work=work, tiles=tiles, outputs=given)


def _convolve(dev, m, sources, *, work, tiles, outputs):
    """outputs: arguments of the last kernel."""
    out = outputs["out"]
    height, width, co = out.shape
    channels = [source.shape[2] for source in sources]
    ci = sum(channels)
    _check_channels(*channels, co)
    if any(source.shape[:2] != (height, width) for source in sources):
        raise ValueError(f"Winograd convolution of {[s.shape for s in sources]} to {out.shape}")
    check_size("transformed weights", work.weights, transformed_floats(m, ci, co))
    check_size("scratch", work.scratch, scratch_floats(dev, m, ci, co))
    tiles = checked_tiles(dev, tiles, height, width)
    program, items = _program(dev, m, co)
    group = _group_tiles(co, items)
    number, step = tiles.number * (SIDE // m) ** 2, tiles_at_a_time(dev, m, ci, co)
    for first in range(0, number, step):
        count = min(step, number - first)
        part = {"first": first, "count": count, "tile_list": tiles.list, "scratch": work.scratch}
        program.launch(
            "winograd_gemm_inputs",
            (ci, count),
            c1=channels[0],
            c2=sum(channels[1:]),
            x=sources[0],
            x2=sources[-1],
            **part,
        )
        program.launch(
            "winograd_gemm_multiply",
            (-(-count // group) * items, co // (4 * quads(co, True)), positions(m)),
            local=(items, 1, 1),
            ci=ci,
            co=co,
            count=count,
            transformed=work.weights,
            scratch=work.scratch,
        )
        program.launch(
            "winograd_gemm_outputs",
            (co, count),
            ci=ci,
            co=co,
            **part,
            **outputs,
        )


def _check_channels(*channels):
    if not fits(*channels):
        raise ValueError(
            f"Winograd convolution of {' + '.join(map(str, channels[:-1]))} to {channels[-1]}"
            " channels: channels come in multiples of 16"
        )


def _group_tiles(co, items):
    """Tiles that a work-group of so many items multiplies."""
    return items * ITEM_SUMS // (4 * quads(co, True))


def _program(dev, m, co) -> tuple[Program, int]:
    """(program, work-items of a work-group that multiplies)."""
    for items in GROUPS:
        program = dev.program("layers/winograd_gemm", WINO_M=m, QUADS=quads(co, True), ITEMS=items)
        if runs(program, "winograd_gemm_multiply", items):
            break
    return program, items
