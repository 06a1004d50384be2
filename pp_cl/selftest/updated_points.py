"""Points whose SH coefficients RMSprop moves, by its kernels and by their float64 twin alike."""

from collections.abc import Sequence

import numpy as np

from pp_cl.device.device import Device
from pp_cl.raster.points import SH_DEGREES, sh_blocks
from pp_cl.raster.project import ProjectedPoints
from pp_cl.reference import optim
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid
from pp_cl.training.optim import rmsprop_update

GRID = Grid((-0.7, -0.5, -0.6), 0.05, (23, 19, 31))
SH_EPS = 4e-7  # of the tiny preset
RATES = (0.1, 0.05, 0.025)
EYE = np.array([1.5, -2.5, 1.2])
CAMERA = Camera.look_at(EYE, (0.1, 0.2, -0.3), fx=100, width=100, height=100)


class Cloud:
    """n points on the grid with random coefficients up to a degree, and their float64 twin."""

    def __init__(self, dev: Device, rng: np.random.Generator, n: int, degree: int = SH_DEGREES[-1]):
        self.dev, self.n, self.steps = dev, n, 0
        self.blocks = sh_blocks(degree)
        ids = np.sort(rng.choice(np.prod(GRID.dims), n, replace=False)).astype(np.uint32)
        count = sum(block.count for block in self.blocks)
        self.start = rng.standard_normal((n, count, 16)).astype(np.float32)
        self.twin = optim.RmsProp(self.start, optim.basis(GRID.positions(ids), EYE)[:, :count])
        self.sh = [dev.upload(self.start[:, b.first : b.first + b.count]) for b in self.blocks]
        self.v, self.last_step = dev.zeros((n, 16)), dev.zeros((n,), np.uint32)
        self._points = seen_points(dev, GRID.positions(ids), CAMERA)

    def step(
        self,
        grad_features: np.ndarray,
        shaded: np.ndarray,
        step: int | None = None,
        *,
        rates: Sequence[float] = RATES,
    ) -> None:
        """One step, or that of another number. grad_features: (N, 16); the kernels must not read
        those of points that are not shaded, which are NaN.
        """
        self.steps = step or self.steps + 1
        seen = np.isin(np.arange(self.n), shaded)[:, None]
        features = self.dev.upload(np.where(seen, grad_features, np.nan), np.float32)
        rmsprop_update(
            self.dev,
            self.steps,
            self._points,
            self.dev.upload(shaded, np.uint32),
            features,
            self.sh,
            v=self.v,
            last_step=self.last_step,
            rates=rates,
            eps=SH_EPS,
        )
        self.twin.step(
            self.steps, np.where(seen, grad_features, 0), np.repeat(rates, (1, 3, 5)), SH_EPS
        )

    def coefficients(self) -> np.ndarray:
        """(N, count, 16) float32 on the host."""
        return np.concatenate([array.get() for array in self.sh], axis=1)

    def second_moment(self) -> np.ndarray:
        """(N, 16) float64: with the decay that waits."""
        waited = self.steps - self.last_step.get().astype(np.float64)
        return self.v.get() * 0.999 ** waited[:, None]


def seen_points(dev: Device, positions: np.ndarray, camera: Camera) -> ProjectedPoints:
    """Points (N, 3) in the camera's axes; a view's other arrays are absent."""
    towards = positions - camera.eye
    distance = np.linalg.norm(towards, axis=1)
    rows = np.column_stack([towards @ camera.pose[:, :3], distance]).astype(np.float32)
    absent = (dev.zeros((1,)),) * 3
    return ProjectedPoints("soft", dev.upload(camera.packed((2.0, 6.0))), dev.upload(rows), *absent)


def gradients(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 16) float32 of the features; every third point's are 0."""
    features = 1e-4 * rng.standard_normal((n, 16))
    features[::3] = 0
    return features.astype(np.float32)
