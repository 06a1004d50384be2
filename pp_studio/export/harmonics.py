"""Measures what each point of a run contributes to its training views, and fits spherical harmonics
of colour to each point, so that viewers can draw the run without the network.

An image is linear in the points' coefficients: it is the known blend weights of its pixels times
the colours of the points in the directions from the eye. The coefficients minimise the squared
differences from the run's own renderings of the training views, by conjugate gradients.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from pp_cl import Camera, Run, track
from pp_cl.engine import RenderResult, evenly

COUNT = 9  # functions of basis()
COLOURS = slice(3)  # used here of the 16 blended features; the next is 0 in all points
# Ridge on all functions but the constant one, per blend weight: a point that few views show keeps
# no slopes. On the demo's test views, 0.003 is 0.8 dB better than 0.03.
RIDGE = 0.003
SHARED = 150_000  # points, on surfaces, that have colours of their own before any fit
LEAST = 1e-6  # ridge weight of a point that is never seen: its colour stays 0


@dataclass
class Observation:
    """A run's N points in a view of H x W pixels, valid until the next view is requested. The blend
    weights (HW, S) of the visible points are a linear map: blended() applies it and gathered() its
    transpose, both only if blending=True was passed to observe().
    """

    run: Run
    camera: Camera
    view: RenderResult

    def point_weights(self) -> np.ndarray:
        """(N,) float32: each point's blend weights, summed over the pixels."""
        dev, n = self.run.dev, self.run.model.cloud.count
        weights, times_seen = dev.zeros((n,)), dev.zeros((n,))
        self.run.renderer.record_weights(self.view, weights, times_seen)
        return weights.get()

    @cached_property
    def visible(self) -> np.ndarray:
        """(S,) indices of the visible points, ascending."""
        return self.view.weights.visible.get()

    def blended(self, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((HW, 3), (HW,)) float32: colours (S, 3) blended by the weights, and 1 less the sum of
        each pixel's weights.
        """
        rows = np.zeros((len(colours), 16), np.float32)
        rows[:, COLOURS] = colours
        pixels = self.run.renderer.blend(self.view, rows).reshape(-1, 16)
        rest = pixels[:, 3]  # weight of the background, whose features are 1
        return pixels[:, COLOURS] - rest[:, None], rest

    def gathered(self, pixels: np.ndarray) -> np.ndarray:
        """(S, C) float32: for each point, the sum of the pixels (HW, C) times its weights there; C
        is at most 16.
        """
        count = pixels.shape[1]
        features = np.zeros((self.camera.height, self.camera.width, 16), np.float32)
        features[..., :count] = pixels.reshape(*features.shape[:2], count)
        return self.run.renderer.gather(self.view, features)[:, :count]

    def functions(self, positions: np.ndarray) -> np.ndarray:
        """(S, 9) float32: basis() of the directions from the eye to the visible points. positions:
        (N, 3), of all points.
        """
        return _functions(self.camera, positions[self.visible])


def _functions(camera, places):
    """(S, 9) float32: basis() of the directions from the eye to places (S, 3)."""
    towards = places - camera.eye
    return basis(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def _summed(groups, values):
    """((G,) the groups, ascending; (G, C) float32 sums of their rows of values (S, C))."""
    rows, index = np.unique(groups, return_inverse=True)
    if len(rows) == len(groups):
        return rows, values
    sums = [np.bincount(index, column, len(rows)) for column in values.T]
    return rows, np.stack(sums, 1).astype(np.float32)


def cubes(places: np.ndarray, cell: float, most: float) -> np.ndarray:
    """(N,) the number of the cube in which each of the places (N, 3) lies. cell: side of the cubes,
    or a larger one of at most `most` cubes, if the places lie on surfaces.
    """
    while True:
        cube = (places // cell).astype(np.int64)
        cube -= cube.min(0)
        key = np.ravel_multi_index(tuple(cube.T), tuple(cube.max(0) + 1))
        group = np.unique(key, return_inverse=True)[1].ravel()
        if (count := group.max() + 1) <= most:
            return group
        cell *= max(1.05, math.sqrt(count / most))


def observe(
    run: Run, cameras: list[Camera], text: str, *, blending: bool = False
) -> Iterator[Observation]:
    """Yield the Observation of each camera in turn. text: label of the progress bar."""
    observation = None
    for camera in track(cameras, text, "view"):
        if observation:
            del observation.view  # frees its arrays before the next view makes larger ones
        observation = _look(run, camera, blending)
        yield observation


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
    """(N, 9, 3) float32: coefficients of basis() for the sRGB colour of each of the run's points; 0
    for points that no view shows. most: use this many training views, spread evenly; None: all.

    Colours are blended like features, over white, and clamped only then: a point's own may lie
    outside [0, 1]. The normal equations A c = b are solved by `steps` + 1 steps of conjugate
    gradients, preconditioned by each point's block of A. Each step recomputes the views' weights,
    since those of all views would fill the memory. steps: -1 applies the preconditioner to b alone:
    each point gets the weighted mean colour of its pixels, or, of more than SHARED points, of those
    of all points in its cube.
    """
    cameras, positions = evenly(run.cameras("train"), most), run.model.positions()
    group, n = np.arange(len(positions)), len(positions)
    if steps < 0 and n > SHARED:
        group = cubes((positions - run.model.grid.origin) / run.model.grid.voxel_size, 1.0, SHARED)
        n = group.max() + 1
        columns = [np.bincount(group, axis, n) for axis in positions.T]
        positions = np.stack(columns, 1) / np.bincount(group, minlength=n)[:, None]
    b, blocks = np.zeros((n, COUNT, 3), np.float32), np.zeros((n, COUNT, COUNT), np.float32)
    for camera in track(cameras, "colours", "view"):
        rendered = run.render(camera)
        colours = np.float32(rendered.colour - (1 - rendered.alpha)[..., None]).reshape(-1, 3)
        observation = _look(run, camera, blending=True)
        sums = observation.gathered(np.column_stack([np.ones(len(colours)), colours]))
        rows, sums = _summed(group[observation.visible], sums)
        at = _functions(camera, positions[rows])
        b[rows] += at[:, :, None] * sums[:, None, 1:]
        blocks[rows] += (sums[:, :1] * at)[:, :, None] * at[:, None]
        del observation
    ridge = RIDGE * blocks[:, :1, 0] * (np.arange(COUNT) > 0) + LEAST
    diagonal = np.arange(COUNT)
    blocks[:, diagonal, diagonal] += ridge
    inverse = np.linalg.inv(blocks)

    if steps < 0:
        return (inverse @ b).astype(np.float32)[group]

    def product(flat):
        coefficients = flat.reshape(b.shape)
        result = ridge[..., None] * coefficients
        for observation in observe(run, cameras, "colours by direction", blending=True):
            at, rows = observation.functions(positions), observation.visible
            colours, _ = observation.blended(np.einsum("nk,nkc->nc", at, coefficients[rows]))
            result[rows] += at[:, :, None] * observation.gathered(colours)[:, None]
        return result.ravel()

    def operator(function):
        return LinearOperator((b.size, b.size), matvec=function, dtype=np.float32)

    preconditioner = operator(lambda flat: (inverse @ flat.reshape(b.shape)).ravel())
    solution, _ = cg(operator(product), b.ravel(), maxiter=steps + 1, M=preconditioner)
    return solution.reshape(b.shape).astype(np.float32)
