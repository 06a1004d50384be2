"""All that is learned: the points on the grid, and the U-Net that turns their features into
colours.
"""

import numpy as np

from pp_cl.errors import UserError
from pp_cl.network.unet import UNet
from pp_cl.raster.sh import SH_DEGREES, sh_blocks
from pp_cl.scene.grid import Grid


class Model:
    """Points and network on a device.

    degree: of the SH, 0 to 2. blocks: points.ShBlock of each array of coefficients. grid: Grid.
    depth_range: (near, far), world units, of cameras that bring none. points: {"ids" (N) uint32
    ascending, "opacity" (N), "sh0" (N,1,16), "sh1" (N,3,16), "sh4" (N,3,16), "sh7" (N,2,16)} device
    arrays, see points.SH_BLOCKS, as far as the degree goes; training adds rows of its own. keys: of
    the learned ones, all but "ids".
    """

    def __init__(self, dev, grid, depth_range, points, net, degree):
        self.dev = dev
        self.degree = degree
        self.blocks = sh_blocks(degree)
        self.keys = ("opacity", *(block.name for block in self.blocks))
        self.grid = grid
        self.grid_buffer = dev.upload(grid.packed())
        self.depth_range = depth_range
        self.points = points
        self.net = net

    @property
    def count(self):
        """Number of points."""
        return self.points["ids"].shape[0]

    @property
    def cloud(self):
        from types import SimpleNamespace

        return SimpleNamespace(
            count=self.count,
            ids=self.points["ids"],
            opacity=self.points["opacity"],
            sh=[self.points[b.name] for b in self.blocks],
        )

    @classmethod
    def create(cls, dev, grid, ids, depth_range, widths, seed, degree=SH_DEGREES[-1], policy=None):
        """Fresh model: opacity 1, SH coefficients 0, network at its random start.

        ids: (N) uint32 ascending grid vertices. policy: of the network's convolutions, None = as
        shipped.
        """
        n = len(ids)
        points = {"ids": dev.upload(ids, np.uint32), "opacity": dev.upload(np.ones(n, np.float32))}
        for block in sh_blocks(degree):
            points[block.name] = dev.zeros((n, block.count, 16))
        net = UNet(dev, widths, seed=seed, policy=policy)
        return cls(dev, grid, depth_range, points, net, degree)

    def header(self):
        """JSON-able description that load() needs beside the arrays."""
        return {
            "grid": {
                "origin": [float(x) for x in self.grid.origin],
                "edge": float(self.grid.edge),
                "dims": [int(d) for d in self.grid.dims],
            },
            "depth_range": [float(x) for x in self.depth_range],
        }

    def arrays(self):
        """{name: numpy array} of everything learned; the SH coefficients by degree, (N,1,16),
        (N,3,16), (N,5,16).
        """
        stored = {f"points.{name}": self.points[name].get() for name in ("ids", "opacity")}
        for degree in SH_DEGREES[: self.degree + 1]:
            parts = [
                self.points[block.name].get() for block in self.blocks if block.degree == degree
            ]
            stored[f"points.sh{degree}"] = np.concatenate(parts, 1)
        return stored | {f"net.{name}": array.get() for name, array in self.net.parameters.items()}

    @classmethod
    def load(cls, dev, header, arrays, widths, degree, file, *, policy=None):
        """Model of a checkpoint's header and arrays. Raises UserError naming the file and the array
        that does not fit.
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
        net = UNet(dev, widths, policy=policy)
        n = len(arrays.get("points.ids", ()))
        shapes = {"ids": (n,), "opacity": (n,)} | {
            f"sh{d}": (n, 2 * d + 1, 16) for d in SH_DEGREES[: degree + 1]
        }
        stored = {
            name: _fitting(arrays, f"points.{name}", shape, file) for name, shape in shapes.items()
        }
        points = {name: dev.upload(stored[name]) for name in ("ids", "opacity")}
        for block in sh_blocks(degree):
            start = block.first - block.degree**2  # in its degree
            points[block.name] = dev.upload(
                stored[f"sh{block.degree}"][:, start : start + block.count]
            )
        for name, parameter in net.parameters.items():
            parameter.set(_fitting(arrays, f"net.{name}", parameter.shape, file))
        return cls(dev, grid, depth_range, points, net, degree)


def _fitting(arrays, name, shape, file):
    expected = np.uint32 if name == "points.ids" else np.float32
    array = arrays.get(name)
    if array is None or array.shape != tuple(shape) or array.dtype != expected:
        found = "missing" if array is None else f"{array.dtype} {array.shape}"
        raise UserError(
            f"{file}: {name} is {found}, expected {np.dtype(expected)} {tuple(shape)}; "
            "its config.json may belong to another run"
        )
    return np.ascontiguousarray(array)
