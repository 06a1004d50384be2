"""Direct convolutions for GPUs: a work-group shares inputs and weights in local memory, and
computes tiles of a list. Any channels, 1x1 and 3x3; weights and parts are DirectConv's.
"""

import math

from pyopencl.array import Array

from pp_cl.engine.layers.conv_direct import DirectConv, Sources, most_parts
from pp_cl.engine.layers.tiles import SIDE, VECTOR, Tiles, grid_shape

QUAD = 4  # channels of a work-item
# Pixels of a work-item: two lines of a tile, ROWS in cl/layers/conv_local.cl.
TILE_PARTS = 2
# Work-items of a group that are tried, until a device runs so many. More share the weights, and fit
# 32 KiB of local memory up to the first number.
GROUPS = (256, 128, 64, 32)
# {side of the kernel: groups of four input channels of a work-group} in the gradient of the weights
CI_QUADS = {3: 4, 1: 8}
# Tiles that a work-item sums in registers there, at most: one sum over an image of background would
# lose digits. Fewer of narrow images, so that it sums half as many pixels as the direct kernel,
# which sums a row: errors stay below that one's.
SUMMED = 4
# Parts of that sum: each of at least so many tiles, and no more than fill a large GPU: so many
# work-groups in all.
PART_TILES = 8
MOST_GROUPS = 512


class LocalConv(DirectConv):
    """Its kernels are conv_local.cl and conv_local_backward_weights.cl."""

    def _launch(self, kernel, tiles, channels, inputs, **arguments):
        """See DirectConv; in the largest groups that the device runs."""
        kernel, aligned = f"conv_local_{kernel}", _is_aligned(channels, *inputs)
        in_group = _quads(channels, aligned)
        for items in (n for n in GROUPS if n >= TILE_PARTS * in_group):
            program = self.dev.program(
                "layers/conv_local",
                ITEMS=items,
                KERNEL_SIZE=self.shape.k,
                ALIGNED=int(aligned),
                QUADS=in_group,
            )
            if program.kernels[kernel].largest_group >= items:
                break
        groups = -(-tiles.number * TILE_PARTS * in_group // items)
        program.launch(
            kernel,
            (groups * items, -(-channels // (QUAD * in_group))),
            local=(items, 1),
            multiply_adds=self._multiply_adds(tiles),
            tile_list=tiles.list,
            **arguments,
        )

    def backward_weights(
        self, sources: Sources, grad_out: Array, partial: Array, *, tiles: Tiles
    ) -> int:
        """See DirectConv."""
        self._check(partial, tiles)
        k, ci, co, (_, width) = self.shape.k, self.shape.ci, self.shape.co, self.shape.size
        run = max(SUMMED, -(-tiles.number // self._parts()))
        parts, first = -(-tiles.number // run), 0
        for source, c in zip(sources, self.shape.sources, strict=True):
            program, in_group, items = self._weights_program(c)
            program.launch(
                "conv_local_backward_weights",
                (-(-c // (QUAD * CI_QUADS[k])) * items, -(-co // (QUAD * in_group)), parts),
                local=(items, 1, 1),
                multiply_adds=tiles.number * SIDE**2 * k**2 * c * co,
                along=2,
                c=c,
                first=first,
                ci=ci,
                summed=max(1, min(SUMMED, width // (2 * SIDE * SIDE))),
                x=source,
                co=co,
                run=run,
                grad_out=grad_out,
                tile_list=tiles.list,
                tile_count=tiles.count,
                partial=partial,
            )
            first += c
        program.launch(
            "conv_local_backward_bias",
            (-(-co // VECTOR) * VECTOR, parts),
            per_block=k * k * ci,
            parts=parts,
            co=co,
            run=run,
            grad_out=grad_out,
            tile_list=tiles.list,
            tile_count=tiles.count,
            partial=partial,
        )
        return parts

    def _parts(self):
        k, ci, co = self.shape.k, self.shape.ci, self.shape.co
        quads = _quads(co, _is_aligned(*self.shape.sources, co))
        groups = -(-ci // (QUAD * CI_QUADS[k])) * -(-co // (QUAD * quads))
        tiles = math.prod(grid_shape(*self.shape.size))
        wanted = min(-(-tiles // PART_TILES), -(-MOST_GROUPS // groups))
        return min(wanted, most_parts(self.shape))

    def _weights_program(self, c):
        """(program, groups of four output channels and work-items of a work-group)."""
        k, aligned = self.shape.k, _is_aligned(c, self.shape.co)
        most = _quads(self.shape.co, aligned)
        for in_group in (n for n in (16, 8, 4) if n <= most):
            items = CI_QUADS[k] * in_group * k
            program = self.dev.program(
                "layers/conv_local_backward_weights",
                KERNEL_SIZE=k,
                CI_QUADS=CI_QUADS[k],
                QUADS=in_group,
                ALIGNED=int(aligned),
            )
            if program.kernels["conv_local_backward_weights"].largest_group >= items:
                break
        return program, in_group, items


def _is_aligned(*channels):
    """Whether four channels of a pixel are read and written at once."""
    return all(c % QUAD == 0 for c in channels)


def _quads(channels, aligned):
    """Groups of four of the output channels that a work-group computes: 16, 8 or 4, so that nothing
    is computed in vain. Channels that are not aligned are few.
    """
    blocks = -(-channels // VECTOR)
    return VECTOR // QUAD * (math.gcd(blocks, 4) if aligned else 1)
