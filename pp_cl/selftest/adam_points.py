"""Points updated by the kernels of Adam and by its float64 twin alike."""

from collections.abc import Iterator

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.raster.sh import SH_BLOCKS, ShBlock
from pp_cl.reference import optim
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.settings import TrainConfig
from pp_cl.training.adam import Directions, PointAdam, ShGradient, UpdatedPoints
from pp_cl.training.point_state import PointState

GRID = Grid((-0.7, -0.5, -0.6), 0.05, (23, 19, 31))


SH_EPS = 4e-7  # of the tiny preset


EYE = np.array([1.5, -2.5, 1.2])


CAMERA = Camera(np.column_stack([np.eye(3), EYE]), 100, 100, 50, 50, 100, 100)


def moments(dev: Device, parameter: np.ndarray | Array) -> dict[str, Array]:
    """Adam's moments of a parameter, zeros."""
    return {kind: dev.zeros(parameter.shape) for kind in "mv"}


def sh_moments(dev: Device, block: ShBlock, n: int, scale: float | None = None) -> dict[str, Array]:
    """Those of the coefficients of n points; scale: of moments of 16 bits."""
    table = PointState.table(n, [block], TrainConfig(moments_16bit=scale is not None))
    return {
        name.partition(".")[0]: dev.zeros(*row)
        for name, row in table.items()
        if name.endswith(block.name)
    }


class Cloud:
    """Points whose opacities and SH coefficients of one block are trained, and their float64
    twins.
    """

    def __init__(
        self,
        dev: Device,
        rng: np.random.Generator,
        n: int,
        block: ShBlock = SH_BLOCKS[0],
        *,
        lazy: bool = True,
        scale: float | None = None,
    ):
        self.dev, self.n, self.block, self.lazy, self.scale = dev, n, block, lazy, scale
        self.ids = np.sort(rng.choice(np.prod(GRID.dims), n, replace=False)).astype(np.uint32)
        self.start = {
            "opacity": rng.random(n).astype(np.float32),
            "sh": rng.standard_normal((n, block.count, 16)).astype(np.float32),
        }
        self.twins = {name: optim.Adam(start) for name, start in self.start.items()}
        self.adam, self.steps = PointAdam(dev, scale), 0
        self.last_step = dev.zeros((n,), np.uint32)
        self.opacity, self.sh = dev.upload(self.start["opacity"]), dev.upload(self.start["sh"])
        self.opacity_moments = moments(dev, self.start["opacity"])
        self.sh_moments = sh_moments(dev, block, n, scale)
        self.directions = Directions(
            dev.upload(GRID.packed()),
            dev.upload(CAMERA.packed((2.0, 6.0))),
            dev.upload(self.ids),
        )

    def updated(self, rows: np.ndarray) -> UpdatedPoints:
        """The points of this step."""
        if not self.lazy:
            return self.adam.all_points(self.steps, self.n)
        rows = self.dev.upload(rows, np.uint32)
        return self.adam.listed_points(self.steps, rows, self.last_step)

    def update_opacity(self, grad_opacity: Array) -> None:
        """Of all points, by (N,)."""
        self.adam.update_opacity(
            self.steps, grad_opacity, self.opacity, self.opacity_moments, rate=0.03, eps=1e-15
        )

    def step(
        self,
        grad_features: np.ndarray,
        grad_opacity: np.ndarray,
        rows: np.ndarray,
        step: int | None = None,
    ) -> None:
        """Update the SH of the rows, whose kernels must not read the gradients of the others, which
        are NaN, and all opacities.
        """
        self.steps = step or self.steps + 1
        for twin in self.twins.values():
            twin.go_to(self.steps - 1)
        self.twins["opacity"].last_step[:] = self.steps - 1  # dense
        listed = np.isin(np.arange(self.n), rows)[:, None]
        features = self.dev.upload(np.where(listed, grad_features, np.nan), np.float32)
        updated, product = self.updated(rows), ShGradient(self.directions, features)
        self.adam.update_sh(
            updated,
            self.block,
            product,
            self.sh,
            moments=self.sh_moments,
            rate=0.1,
            eps=SH_EPS,
        )
        self.update_opacity(self.dev.upload(grad_opacity, np.float32))
        self.twins["sh"].step(self.sh_gradient(grad_features), 0.1, SH_EPS, rows=rows)
        self.twins["opacity"].step(grad_opacity, 0.03, 1e-15, low=0, high=1)

    def sh_gradient(self, grad_features: np.ndarray) -> np.ndarray:
        """(N, block.count, 16) float64."""
        return optim.sh_gradient(GRID.positions(self.ids), EYE, grad_features, self.block)

    def pending(self, rows: np.ndarray, step: int) -> np.ndarray:
        """(N, 16) that lazy Adam adds to features of 0 of the rows in `step`; NaN elsewhere."""
        features = np.full((self.n, 16), np.nan, np.float32)
        features[rows] = 0
        features = self.dev.upload(features)
        rows = self.dev.upload(rows, np.uint32)
        listed = self.adam.listed_points(step, rows, self.last_step, updating=False)
        self.adam.add_pending(
            listed,
            self.block,
            self.directions,
            features,
            moments=self.sh_moments,
            rate=0.1,
            eps=SH_EPS,
        )
        return features.get()

    def state(self) -> dict[str, list[np.ndarray]]:
        """{name: (parameter, m, v)} on the host."""
        if self.scale is None:
            sh = [self.sh.get(), *(array.get() for array in self.sh_moments.values())]
        else:
            m, root = np.moveaxis(self.sh_moments["mv"].get().astype(np.float64), 2, 0) / self.scale
            sh = [self.sh.get(), m, root**2]
        opacity = [self.opacity, *self.opacity_moments.values()]
        return {"sh": sh, "opacity": [array.get() for array in opacity]}

    def compared(self) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
        """Parameters and moments beside those of the twins, and the bounds of their errors,
        relative to the largest: that of v is three times as large, as it is a sum of squares.
        """
        for name, (parameter, m, v) in self.state().items():
            twin = self.twins[name]
            yield parameter, twin.parameter, 1e-6
            yield m, twin.m, 1e-6
            yield v, twin.v, 3e-6


def gradients(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(of the features, of the opacity); every third point's are 0."""
    features, opacity = 1e-4 * rng.standard_normal((n, 16)), 1e-5 * rng.standard_normal(n)
    features[::3], opacity[::3] = 0, 0
    return features.astype(np.float32), opacity.astype(np.float32)
