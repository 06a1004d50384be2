"""All that is learned: the points on the grid, and the U-Net that turns their features into
colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Table
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.network.unet import UNet
from pp_cl.raster.sh import SH_BLOCKS, SH_DEGREES, ShBlock, sh_blocks
from pp_cl.scene.grid import Grid
from pp_cl.training.prune import compact_rows


@dataclass
class PointCloud:
    """The points, one row each; device arrays.

    ids: (N) uint32, vertices of the grid, ascending. opacity: (N) float32 in [0, 1]. sh: the SH
    coefficients, (N, count, 16) float32 of each block.
    """

    ids: Array
    opacity: Array
    sh: list[Array]

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
        table = {"ids": ((n,), np.uint32), "opacity": ((n,), np.float32)}
        return table | {block.name: ((n, block.count, 16), np.float32) for block in blocks}

    @classmethod
    def create(cls, dev: Device, ids: np.ndarray, degree: int) -> PointCloud:
        """Points of opacity 1 with SH coefficients of 0. ids: (N), ascending."""
        blocks, n = sh_blocks(degree), len(ids)
        table = cls.table(n, blocks)
        opacity = dev.upload(np.ones(n, np.float32))
        sh = [dev.zeros(*table[block.name]) for block in blocks]
        return cls(dev.upload(ids, np.uint32), opacity, sh)

    def learned(self) -> dict[str, Array]:
        """{name: array} of all that training changes: "opacity", and the SH by block."""
        names = (block.name for block in self.blocks)
        return {"opacity": self.opacity} | dict(zip(names, self.sh, strict=True))

    def compact(self, dev: Device, keep: Array) -> None:
        """Drop all rows but `keep`, (M) uint32, ascending; one array after the other."""
        self.ids = compact_rows(dev, self.ids, keep)
        self.opacity = compact_rows(dev, self.opacity, keep)
        for i in range(len(self.sh)):
            self.sh[i] = compact_rows(dev, self.sh[i], keep)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays as a checkpoint names them; the SH by degree, (N, 1, 16), (N, 3, 16),
        (N, 5, 16).
        """
        stored = {"points.ids": self.ids.get(), "points.opacity": self.opacity.get()}
        for degree in sorted({block.degree for block in self.blocks}):
            parts = [
                array.get()
                for block, array in zip(self.blocks, self.sh, strict=True)
                if block.degree == degree
            ]
            stored[f"points.sh{degree}"] = np.concatenate(parts, 1)
        return stored

    @classmethod
    def load(
        cls, dev: Device, arrays: dict[str, np.ndarray], degree: int, file: Path
    ) -> PointCloud:
        """The points of a checkpoint's arrays. Raises UserError as Model.load does."""
        n = len(arrays.get("points.ids", ()))
        ids = _fitting(arrays, "points.ids", (n,), file, dtype=np.uint32)
        opacity = _fitting(arrays, "points.opacity", (n,), file)
        by_degree = [
            _fitting(arrays, f"points.sh{d}", (n, 2 * d + 1, 16), file)
            for d in SH_DEGREES[: degree + 1]
        ]
        sh = []
        for block in sh_blocks(degree):
            start = block.first - block.degree**2  # within its degree
            sh.append(dev.upload(by_degree[block.degree][:, start : start + block.count]))
        return cls(dev.upload(ids), dev.upload(opacity), sh)


class Model:
    """Points and network on a device.

    grid: the vertices that points lie on; grid_buffer: the same, packed, (8) float32 on the
    device. depth_range: (near, far), distances from the eye in world units, of all cameras.
    """

    def __init__(
        self,
        dev: Device,
        grid: Grid,
        depth_range: tuple[float, float],
        cloud: PointCloud,
        *,
        net: UNet,
    ):
        self.dev = dev
        self.grid = grid
        self.grid_buffer = dev.upload(grid.packed())
        self.depth_range = depth_range
        self.cloud = cloud
        self.net = net

    @property
    def count(self) -> int:
        """Number of points."""
        return self.cloud.count

    @classmethod
    def create(
        cls,
        dev: Device,
        grid: Grid,
        ids: np.ndarray,
        depth_range: tuple[float, float],
        *,
        net: UNet,
        degree: int = SH_DEGREES[-1],
    ) -> Model:
        """Fresh model: points of opacity 1 with SH coefficients of 0, and a network.

        ids: (N) ascending grid vertices. degree: of the SH, 0 to 2.
        """
        return cls(dev, grid, depth_range, PointCloud.create(dev, ids, degree), net=net)

    def header(self) -> dict:
        """JSON-able description that load() needs beside the arrays."""
        return {
            "grid": {
                "origin": [float(x) for x in self.grid.origin],
                "edge": float(self.grid.edge),
                "dims": [int(d) for d in self.grid.dims],
            },
            "depth_range": [float(x) for x in self.depth_range],
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """{name: array} of everything learned, as a checkpoint stores it."""
        network = {f"net.{name}": array.get() for name, array in self.net.parameters.items()}
        return self.cloud.arrays() | network

    @classmethod
    def load(
        cls,
        dev: Device,
        header: dict,
        arrays: dict[str, np.ndarray],
        net: UNet,
        *,
        degree: int,
        file: Path,
    ) -> Model:
        """Model of a checkpoint's header and arrays; net takes the parameters stored there.

        Raises UserError naming the file and the array that does not fit.
        """
        try:
            grid = Grid(
                tuple(header["grid"]["origin"]),
                header["grid"]["edge"],
                tuple(header["grid"]["dims"]),
            )
            depth_range = tuple(header["depth_range"])
        except (KeyError, TypeError):
            raise UserError(f"{file}: its header is incomplete; train anew") from None
        cloud = PointCloud.load(dev, arrays, degree, file)
        for name, parameter in net.parameters.items():
            parameter.set(_fitting(arrays, f"net.{name}", parameter.shape, file))
        return cls(dev, grid, depth_range, cloud, net=net)


def _fitting(arrays, name, shape, file, *, dtype=np.float32):
    """The array called `name`, contiguous. Raises UserError where it is missing or differs."""
    array = arrays.get(name)
    if array is None or array.shape != tuple(shape) or array.dtype != dtype:
        found = "missing" if array is None else f"{array.dtype} {array.shape}"
        raise UserError(
            f"{file}: {name} is {found}, expected {np.dtype(dtype)} {tuple(shape)}; "
            "its config.json may belong to another run"
        )
    return np.ascontiguousarray(array)
