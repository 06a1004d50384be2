"""Fits spherical harmonics of colour to each point, so that viewers can draw a run without the
network.

An image is linear in the points' coefficients: the blend weights of its pixels, which are known,
times the colours of the points in the directions from the eye. The coefficients minimise the
squared differences from the run's own renderings of the training views, by conjugate gradients.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from pp_cl import Run
from pp_cl.engine import evenly
from pp_studio.export.observe import directions, look, observe, progress

COUNT = 9  # functions of basis()
# Ridge on all but the constant function, per blend weight: a point that few views show has no
# slopes. On the demo's test views, 0.003 is 0.8 dB better than 0.03.
RIDGE = 0.003
LEAST = 1e-6  # weight of the ridge where a point is never seen: its colour stays 0


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
    weights of all would fill the memory.
    """
    cameras, n = evenly(run.cameras("train"), most), run.model.cloud.count
    positions = run.model.positions()

    def functions(seen):
        return basis(directions(positions[seen.visible], seen.camera))

    b, blocks = np.zeros((n, COUNT, 3), np.float32), np.zeros((n, COUNT, COUNT), np.float32)
    for camera in progress(cameras, "colours"):
        rendered = run.render(camera)
        colours = np.float32(rendered.colour - (1 - rendered.alpha)[..., None]).reshape(-1, 3)
        seen = look(run, camera, blending=True)
        at, rows = functions(seen), seen.visible
        weights = seen.gathered(np.ones_like(colours))[:, :1]
        b[rows] += at[:, :, None] * seen.gathered(colours)[:, None]
        blocks[rows] += (weights * at)[:, :, None] * at[:, None]
        del seen
    ridge = RIDGE * blocks[:, :1, 0] * (np.arange(COUNT) > 0) + LEAST
    diagonal = np.arange(COUNT)
    blocks[:, diagonal, diagonal] += ridge
    inverse = np.linalg.inv(blocks)

    def product(flat):
        coefficients = flat.reshape(b.shape)
        result = ridge[..., None] * coefficients
        for seen in observe(run, cameras, "harmonics", blending=True):
            at, rows = functions(seen), seen.visible
            colours, _ = seen.blended(np.einsum("nk,nkc->nc", at, coefficients[rows]))
            result[rows] += at[:, :, None] * seen.gathered(colours)[:, None]
        return result.ravel()

    def operator(function):
        return LinearOperator((b.size, b.size), matvec=function, dtype=np.float32)

    preconditioner = operator(lambda flat: (inverse @ flat.reshape(b.shape)).ravel())
    solution, _ = cg(operator(product), b.ravel(), maxiter=steps + 1, M=preconditioner)
    return solution.reshape(b.shape).astype(np.float32)
