"""Colours that need no network: harmonics of each point's colour, fitted to what the network
shows.

An image is linear in the points' coefficients: the blend weights of its pixels, which are known,
times the colours of the points in the directions from the eye. The coefficients minimise the
squared differences from the run's own renderings of the training views, by conjugate gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pp_cl.export.observe import directions, observe
from pp_cl.run import Run
from pp_cl.scene.camera import Camera

COUNT = 9  # functions of basis()
# Two steps more fit the training views better and the test views worse (docs/export.md).
STEPS = 3
# Ridge on all but the constant function, per blend weight: a point that few views show has no
# slopes. On the demo's test views, 0.003 is 0.8 dB better than 0.03.
RIDGE = 0.003
LEAST = 1e-6  # weight of the ridge where a point is never seen: its colour stays 0


def basis(towards: np.ndarray) -> np.ndarray:
    """(N, 9) float32: harmonic polynomials of degrees 0 to 2 of unit vectors (N, 3)."""
    x, y, z = towards.T
    rows = [np.ones_like(x), x, y, z, x * y, y * z, x * z, 3 * z * z - 1, x * x - y * y]
    return np.stack(rows, 1).astype(np.float32)


def fit_harmonics(run: Run, steps: int = STEPS, count: int = COUNT) -> np.ndarray:
    """(N, count, 3) float32: coefficients of the first functions of basis(), of the sRGB colour of
    each of the run's points.

    Colours are blended as the features are, over white, and clamped at last: one point's may lie
    outside [0, 1].
    """
    system = _System(run, run.cameras("train"), count)
    residual, inverse = system.start()
    solution = np.zeros_like(residual)
    direction, last = np.zeros_like(residual), 1.0
    for step in range(steps + 1):
        scaled = inverse @ residual
        product = float(np.vdot(residual, scaled))
        if product == 0:
            break
        direction = scaled + (product / last if step else 0.0) * direction
        last = product
        image = system.apply(direction)
        length = product / float(np.vdot(direction, image))
        solution += np.float32(length) * direction
        residual -= np.float32(length) * image
    return solution


@dataclass
class _System:
    """The normal equations of the fit: A c = b. Blend weights are computed anew in every pass,
    since those of all views would fill the memory.
    """

    run: Run
    cameras: list[Camera]
    count: int

    def start(self):
        """(b (N, count, 3), the inverses of A's blocks (N, count, count)), float32."""
        n, count = self.run.model.cloud.count, self.count
        b, blocks = np.zeros((n, count, 3), np.float32), np.zeros((n, count, count), np.float32)
        for seen, matrix, at in self._passes("colours"):
            picture = seen.picture()
            colour = (picture.colour - (1 - picture.alpha)[..., None]).reshape(-1, 3)
            weight = matrix.sum(0)
            b += at[:, :, None] * (matrix.T @ colour)[:, None]
            blocks += (weight[:, None] * at)[:, :, None] * at[:, None]
        self.ridge = RIDGE * blocks[:, :1, 0] * (np.arange(count) > 0) + LEAST
        diagonal = np.arange(count)
        blocks[:, diagonal, diagonal] += self.ridge
        return b, np.linalg.inv(blocks)

    def apply(self, coefficients):
        """A times coefficients (N, count, 3)."""
        result = self.ridge[..., None] * coefficients
        for _, matrix, at in self._passes("harmonics"):
            colour = np.einsum("nk,nkc->nc", at, coefficients)
            result += at[:, :, None] * (matrix.T @ (matrix @ colour))[:, None]
        return result

    def _passes(self, text):
        """(observation, blend matrix, basis (N, count)) of each view."""
        grid, cloud = self.run.model.grid, self.run.model.cloud
        positions = grid.positions(cloud.ids.get())
        for seen in observe(self.run, self.cameras, text):
            yield (
                seen,
                seen.blend_matrix(),
                basis(directions(positions, seen.camera))[:, : self.count],
            )
