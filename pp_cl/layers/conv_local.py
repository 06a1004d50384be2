"""How the direct convolution through local memory is launched: a variant of conv.py's for GPUs."""

from pp_cl.layers.tiles import LANES

ITEMS, ROWS, COLUMNS, CHANNELS = 128, 8, 16, 32  # of a work-group of cl/layers/conv_local.cl


def local_program(dev, height, width, *channels):
    """(program, global size, work-group) for a 3x3 convolution; channels: of the sources and of the
    output, which come last.

    Raises ValueError for channels that are no multiples of 16.
    """
    if any(c % LANES for c in channels):
        raise ValueError(
            f"convolution through local memory of channels {channels}: they come in multiples of"
            f" {LANES}"
        )
    size = (-(-width // COLUMNS) * ITEMS, -(-height // ROWS), -(-channels[-1] // CHANNELS))
    return dev.program("layers/conv_local"), size, (ITEMS, 1, 1)
