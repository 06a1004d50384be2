"""What the points of a run add to its training views, and spherical harmonics of colour that are
fitted to each point by it, so that viewers can draw a run without the network.

An image is linear in the points' coefficients: the blend weights of its pixels, which are known,
times the colours of the points in the directions from the eye. The coefficients minimise the
squared differences from the run's own renderings of the training views, by conjugate gradients.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from pp_cl import Camera, Run, track
from pp_cl.engine import RenderResult, evenly

COUNT = 9  # functions of basis()
COLOURS = slice(3)  # of the 16 features that are blended here; that behind them is 0 in all points
# Ridge on all but the constant function, per blend weight: a point that few views show has no
# slopes. On the demo's test views, 0.003 is 0.8 dB better than 0.03.
RIDGE = 0.003
LEAST = 1e-6  # weight of the ridge where a point is never seen: its colour stays 0


@dataclass
class Observation:
    """A run's N points in a view of H x W pixels; gone once the next view is asked for. It is a
    linear map, the blend weights (HW, S) of the visible points, which blended() applies and
    gathered() transposes, both where it was observed with blending=True.
    """

    run: Run
    camera: Camera
    view: RenderResult

    def point_weights(self) -> np.ndarray:
        """(N,) float32: each point's blend weights, summed over the pixels."""
        dev, n = self.run.dev, self.run.model.cloud.count
        weights, seen = dev.zeros((n,)), dev.zeros((n,))
        self.run.renderer.record_weights(self.view, weights, seen)
        return weights.get()

    @cached_property
    def visible(self) -> np.ndarray:
        """(S,) indices of the visible points, ascending."""
        return self.view.weights.visible.get()

    def blended(self, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((HW, 3), (HW,)) float32: colours (S, 3) blended by the weights, and what the weights of
        a pixel leave of 1.
        """
        rows = np.zeros((len(colours), 16), np.float32)
        rows[:, COLOURS] = colours
        pixels = self.run.renderer.blend(self.view, rows).reshape(-1, 16)
        rest = pixels[:, 3]  # of the background, whose features are 1
        return pixels[:, COLOURS] - rest[:, None], rest

    def gathered(self, pixels: np.ndarray) -> np.ndarray:
        """(S, 3) float32: of each point, the sum over the pixels (HW, 3) times its weights."""
        features = np.zeros((self.camera.height, self.camera.width, 16), np.float32)
        features[..., COLOURS] = pixels.reshape(*features.shape[:2], 3)
        return self.run.renderer.gather(self.view, features)[:, COLOURS]

    def functions(self, positions: np.ndarray) -> np.ndarray:
        """(S, 9) float32: basis() of the directions from the eye to the visible ones of the points,
        which lie at positions (N, 3).
        """
        towards = positions[self.visible] - self.camera.eye
        return basis(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def observe(
    run: Run, cameras: list[Camera], text: str, *, blending: bool = False
) -> Iterator[Observation]:
    """What the points contribute to each camera's view, in turn. text: of the progress bar."""
    seen = None
    for camera in track(cameras, text, "view"):
        if seen:
            del seen.view  # else its arrays would stay beside the larger ones of this view
        seen = _look(run, camera, blending)
        yield seen


def _look(run, camera, blending):
    until = "features" if blending else "weights"
    view = run.renderer.forward(camera, run.gamma, until=until, training=blending)
    return Observation(run, camera, view)


def basis(towards: np.ndarray) -> np.ndarray:
    """(N, 9) float32: harmonic polynomials of degrees 0 to 2 of unit vectors (N, 3)."""
    x, y, z = towards.T
    rows = [np.ones_like(x), x, y, z, x * y, y * z, x * z, 3 * z * z - 1, x * x - y * y]
    return np.stack(rows, 1).astype(np.float32)


def fit_harmonics(run: Run, steps: int, most: int | None = None) -> np.ndarray:
    """(N, 9, 3) float32: coefficients of basis(), of the sRGB colour of each of the run's points, 0
    of those that no view shows. most: of the training views, spread evenly; None: all.

    Colours are blended as the features are, over white, and clamped at last: one point's may lie
    outside [0, 1]. The normal equations A c = b are solved by `steps` + 1 steps of conjugate
    gradients, preconditioned by A's blocks of a point. Views are weighed anew in each, since the
    weights of all would fill the memory. steps: -1 takes what the preconditioner makes of b alone:
    means of the colours of a point's pixels, by its weights.
    """
    cameras, n = evenly(run.cameras("train"), most), run.model.cloud.count
    positions = run.model.positions()
    b, blocks = np.zeros((n, COUNT, 3), np.float32), np.zeros((n, COUNT, COUNT), np.float32)
    for camera in track(cameras, "colours", "view"):
        rendered = run.render(camera)
        colours = np.float32(rendered.colour - (1 - rendered.alpha)[..., None]).reshape(-1, 3)
        seen = _look(run, camera, blending=True)
        at, rows = seen.functions(positions), seen.visible
        weights = seen.gathered(np.ones_like(colours))[:, :1]
        b[rows] += at[:, :, None] * seen.gathered(colours)[:, None]
        blocks[rows] += (weights * at)[:, :, None] * at[:, None]
        del seen
    ridge = RIDGE * blocks[:, :1, 0] * (np.arange(COUNT) > 0) + LEAST
    diagonal = np.arange(COUNT)
    blocks[:, diagonal, diagonal] += ridge
    inverse = np.linalg.inv(blocks)

    if steps < 0:
        return (inverse @ b).astype(np.float32)

    def product(flat):
        coefficients = flat.reshape(b.shape)
        result = ridge[..., None] * coefficients
        for seen in observe(run, cameras, "colours by direction", blending=True):
            at, rows = seen.functions(positions), seen.visible
            colours, _ = seen.blended(np.einsum("nk,nkc->nc", at, coefficients[rows]))
            result[rows] += at[:, :, None] * seen.gathered(colours)[:, None]
        return result.ravel()

    def operator(function):
        return LinearOperator((b.size, b.size), matvec=function, dtype=np.float32)

    preconditioner = operator(lambda flat: (inverse @ flat.reshape(b.shape)).ravel())
    solution, _ = cg(operator(product), b.ravel(), maxiter=steps + 1, M=preconditioner)
    return solution.reshape(b.shape).astype(np.float32)
