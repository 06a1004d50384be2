"""The point cloud on the device: grid vertices, offsets from them, radii, opacities, and SH
coefficients in arrays by degree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Table, compact_rows, gather_rows
from pp_cl.engine.device.device import Device
from pp_cl.engine.raster.footprint import FOOTPRINTS, Footprint


@dataclass(frozen=True)
class ShBlock:
    """The SH coefficients in one array (N, count, 16): `count` coefficients of one degree, for the
    basis functions `first`, `first` + 1, ...

    name: sh_ and the degree, then a or b if the degree fills two arrays.
    """

    name: str
    first: int
    count: int

    @property
    def degree(self) -> int:
        """0, 1 or 2."""
        return math.isqrt(self.first)


# Degree 2 fills two arrays, so that no array takes more than 192 bytes a point, and 4.04 million
# points fit devices that allocate at most 1 GiB at once. All devices use this layout and get the
# same bits.
SH_BLOCKS = (
    ShBlock("sh_0", 0, 1),
    ShBlock("sh_1", 1, 3),
    ShBlock("sh_2a", 4, 3),
    ShBlock("sh_2b", 7, 2),
)
SH_DEGREES = (0, 1, 2)
OPACITIES = 9  # numbers in a row of PointCloud.opacity


def sh_blocks(degree: int) -> tuple[ShBlock, ...]:
    """The SH_BLOCKS up to a degree."""
    return tuple(block for block in SH_BLOCKS if block.degree <= degree)


def stored_degree(sh: Sequence[Array]) -> int:
    """The highest degree in `sh`, arrays of the first SH_BLOCKS."""
    return SH_BLOCKS[len(sh) - 1].degree


def four_blocks(sh: Sequence[Array]) -> list[Array]:
    """Four arrays for a kernel's arguments. If the degree is lower, the first array is repeated for
    the missing ones, which a kernel built for that degree does not read.
    """
    return [*sh, *[sh[0]] * (len(SH_BLOCKS) - len(sh))]


@dataclass
class PointCloud:
    """The points, one row each; device arrays.

    ids: (N) uint32, vertices of the grid, ascending. offset: (N, 4) float32, the vector from the
    vertex to the point in its cell, in voxel sizes, and the logarithm of its radius over
    point_radius() of the settings; all within +-kind.most_offset. For Gaussians (N, 16), of which 9
    are used: see cl/cloud.h. opacity: (N, 9) float32, o in [0, 1] and
    coefficients w_k in [-1, 1] of the harmonics Y_k of degrees 1 and 2 in cl/sh.h: seen in a
    direction d, a unit vector from the eye, the point has the opacity o + sum_k w_k Y_k(d), clamped
    to [0, 1]. sh: the SH coefficients, (N, count, 16) for each block: float32, or float16 once they
    are no longer trained. kind: the kind of footprint whose offsets and bounds they have, which are
    those of soft points for all but Gaussians.
    """

    ids: Array
    offset: Array
    opacity: Array
    sh: list[Array]
    kind: Footprint = FOOTPRINTS["soft"]

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.ids)

    @property
    def blocks(self) -> tuple[ShBlock, ...]:
        """The block that each array of `sh` holds."""
        return SH_BLOCKS[: len(self.sh)]

    @staticmethod
    def table(n: int, blocks: tuple[ShBlock, ...]) -> Table:
        """The arrays of n points."""
        table: Table = {"ids": ((n,), np.uint32), "offset": ((n, 4), np.float32)}
        table["opacity"] = (n, OPACITIES), np.float32
        return table | {block.name: ((n, block.count, 16), np.float32) for block in blocks}

    @classmethod
    def create(
        cls,
        dev: Device,
        ids: np.ndarray,
        degree: int = SH_DEGREES[-1],
        opacity: float | np.ndarray = 1.0,
    ) -> PointCloud:
        """Points on their vertices, with SH coefficients of 0 up to a degree, 0 to 2, and the same
        opacity from all sides. ids: (N), ascending. opacity: a number for all points or (N,).
        """
        n = len(ids)
        opacities = _from_all_sides(np.broadcast_to(opacity, n))
        sh = [dev.zeros((n, block.count, 16)) for block in sh_blocks(degree)]
        return cls(dev.upload(ids, np.uint32), dev.zeros((n, 4)), dev.upload(opacities), sh)

    @classmethod
    def of_gaussians(
        cls, dev: Device, ids: np.ndarray, offset: np.ndarray, opacity: np.ndarray, sh: np.ndarray
    ) -> PointCloud:
        """Gaussians for the footprint "gaussian". ids: (N,), ascending. offset: (N, 9) float32, as
        in cl/cloud.h: place in the cell, logarithms of the deviations, entries below the diagonal.
        opacity: (N,). sh: (N, 9, 16), degrees 0 to 2; coefficients above degree 0 are clipped to
        +-kind.most_sh.
        """
        kind = FOOTPRINTS["gaussian"]
        padded = np.zeros((len(ids), kind.offsets), np.float32)
        padded[:, : offset.shape[1]] = offset
        most = np.full((9, 1), kind.most_sh)
        most[0] = np.inf
        begins = [block.first for block in sh_blocks(2)[1:]]
        blocks = np.split(sh.clip(-most, most).astype(np.float32), begins, axis=1)
        opacities = dev.upload(_from_all_sides(opacity))
        sh_arrays = [dev.upload(block) for block in blocks]
        return cls(dev.upload(ids, np.uint32), dev.upload(padded), opacities, sh_arrays, kind)

    def learned(self) -> dict[str, Array]:
        """{name: array that training changes}: "offset", "opacity", and the SH by block."""
        names = (block.name for block in self.blocks)
        places = {"offset": self.offset, "opacity": self.opacity}
        return places | dict(zip(names, self.sh, strict=True))

    def compact(self, dev: Device, keep: Array) -> None:
        """Drop all rows except `keep`, (M) uint32, ascending; one array at a time."""
        self.ids = compact_rows(dev, self.ids, keep)
        self.offset = compact_rows(dev, self.offset, keep)
        self.opacity = compact_rows(dev, self.opacity, keep)
        for i in range(len(self.sh)):
            self.sh[i] = compact_rows(dev, self.sh[i], keep)

    def rows(self, dev: Device, keep: Array) -> PointCloud:
        """A copy of the rows `keep`, (M) uint32, ascending."""
        arrays = self.ids, self.offset, self.opacity, *self.sh
        ids, offset, opacity, *sh = (gather_rows(dev, array, keep) for array in arrays)
        return PointCloud(ids, offset, opacity, sh, self.kind)

    def replace_by(self, dev: Device, ids: np.ndarray, rows: Array) -> None:
        """Become the points `ids`, (M) ascending; each takes what point rows[i] of the present ones
        has learned. Replaces one array at a time. rows: (M,) uint32.
        """
        self.ids = dev.upload(ids, np.uint32)
        self.offset = gather_rows(dev, self.offset, rows)
        self.opacity = gather_rows(dev, self.opacity, rows)
        for i in range(len(self.sh)):
            self.sh[i] = gather_rows(dev, self.sh[i], rows)


def _from_all_sides(opacity):
    """(N, 9) float32, PointCloud.opacity for opacities (N,) that are the same from all sides."""
    return np.pad(np.asarray(opacity, np.float32)[:, None], ((0, 0), (0, OPACITIES - 1)))
