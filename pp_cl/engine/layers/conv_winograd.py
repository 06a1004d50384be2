"""3x3 convolutions by Winograd's minimal filtering F(4 x 4, 3 x 3): 4 times fewer multiplications
than the direct ones, at two or three times the error. Channels come in multiples of 16.
"""

from collections.abc import Sequence

from pyopencl.array import Array

from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.conv_direct import (
    Blocking,
    ConvShape,
    DirectConv,
    Direction,
    Layout,
    Sources,
    parts_shape,
)
from pp_cl.engine.layers.tiles import SIDE, VECTOR, Tiles

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


class WinogradConv(DirectConv):
    """Its kernels are winograd.cl, winograd_transform.cl and winograd_backward_weights.cl. Results
    do not depend on the number of compute units. Raises ValueError for channels that do not fit.
    """

    def __init__(self, dev: Device, blocking: Blocking, shape: ConvShape):
        if not fits(*shape.sources, shape.co):
            channels = *shape.sources, shape.co
            raise ValueError(
                f"Winograd convolution of {channels} channels: they come in multiples of 16"
            )
        super().__init__(dev, blocking, shape)
        narrow = shape.ci * shape.co <= NARROW
        # tiles transformed at a time, and multiplied together
        self._at_once, self._together = blocking.winograd_narrow if narrow else blocking.winograd

    def _work_shape(self):
        ci, co = self.shape.ci, self.shape.co
        if self.shape.direction is Direction.BACKWARD_WEIGHTS:
            return parts_shape(MOST_PARTS if _is_narrow(ci, co) else 1, 3, ci, co)
        # as cl/layers/winograd.h lays them out
        return (POSITIONS * (ci * co + VECTOR),)

    def scratch_floats(self) -> int:
        """Floats of Device.scratch() that the kernels take as SLICES."""
        ci, co = self.shape.ci, self.shape.co
        vectors = POSITIONS * ((ci + co) // VECTOR * self._at_once + 3)
        if self.shape.direction is Direction.BACKWARD_WEIGHTS:
            ci_part, co_part = min(CI_PART, ci), min(CO_PART, co)
            values = (ci_part + co_part) // VECTOR * self.blocking.winograd_weights
            vectors = POSITIONS * (values + 3 + ci_part * co_part // VECTOR) + co_part // VECTOR
        return COUNTERS + self.dev.info["compute_units"] * vectors * VECTOR

    @staticmethod
    def lay_out(dev: Device, weights: Array, jobs: Sequence[Layout], laid_out: Array) -> None:
        """Transform weights in one launch, see DirectConv."""
        rows, n = [], 0
        for shape, start, target in jobs:
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

    def _launch(self, kernel, tiles, channels, inputs, **arguments):
        """See DirectConv."""
        program = self.dev.program(
            "layers/winograd",
            TILES=self._at_once,
            TOGETHER=self._together,
            BLOCKS=self._groups(channels),
        )
        program.launch(
            f"winograd_{kernel}",
            min(self.dev.info["compute_units"], tiles.number),
            local=1,
            tile_list=tiles.list,
            scratch=self.dev.scratch(SLICES, self.scratch_floats(), zeros=COUNTERS),
            **arguments,
        )

    def _groups(self, channels):
        """Groups of 16 output channels that are multiplied together."""
        groups = self.blocking.winograd_groups
        return 1 if channels // VECTOR % groups else groups

    def backward_weights(
        self, sources: Sources, grad_out: Array, partial: Array, *, tiles: Tiles
    ) -> int:
        """See DirectConv."""
        self._check(partial, tiles)
        ci, co, (c1, *others) = self.shape.ci, self.shape.co, self.shape.sources
        units = self.dev.info["compute_units"]
        tile_parts = _tile_parts(tiles.number, ci, co)
        ci_part = ci if tile_parts > 1 else _ci_part(units, ci, co)
        parts = tile_parts * -(-ci // ci_part) * -(-co // CO_PART)
        self.dev.program(
            "layers/winograd_backward_weights",
            TILES=self.blocking.winograd_weights,
            CO_PART=min(CO_PART, co),
            BLOCKS=self._groups(co),
        ).launch(
            "winograd_backward_weights",
            min(units, parts),
            local=1,
            c1=c1,
            c2=sum(others),
            co=co,
            ci_part=ci_part,
            tile_parts=tile_parts,
            x=sources[0],
            x2=sources[-1],
            grad_out=grad_out,
            tile_list=tiles.list,
            tile_count=tiles.count,
            partial=partial,
            scratch=self.dev.scratch(SLICES, self.scratch_floats(), zeros=COUNTERS),
        )
        return tile_parts


def _is_narrow(ci, co):
    return ci <= CI_PART and co <= CO_PART and ci * co <= NARROW_SUMS


def _tile_parts(number, ci, co):
    """Parts of `number` tiles: a power of two, which most numbers of compute units share evenly."""
    parts = 1
    while _is_narrow(ci, co) and parts < MOST_PARTS and number >= 2 * parts * LEAST_TILES:
        parts *= 2
    return parts


def _ci_part(units, ci, co):
    """Input channels of one part, where the tiles are not cut: few enough that every compute unit
    gets a part.
    """
    wanted = -(-units // -(-co // CO_PART))
    return min(CI_PART, max(1, ci // (VECTOR * wanted)) * VECTOR)
