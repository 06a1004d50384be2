"""Eq. (1) in float64 at single pixels, for discs and spheres: what `pp-cl bench raster` measures
errors against.
"""

from typing import Any

import numpy as np

Hits = tuple[np.ndarray, np.ndarray, np.ndarray]  # points, closeness, depth

EPS = 1e-6  # depth of the background, as a z
LEAST_RADIUS = 0.75  # pixels
ROUNDING = 4 * np.finfo(np.float32).eps  # of the distance from a ray, in shares of the range


class PixelReference:
    """Points, all in front of a camera and between near and far, of which some pixels are asked
    for.

    camera: scene.camera.Camera. positions: (N, 3), world. radius: one number, world units. kind:
    disc or sphere, no larger than a few pixels. depth_range: (near, far).
    """

    def __init__(
        self,
        camera: Any,
        positions: np.ndarray,
        radius: float,
        kind: str,
        *,
        depth_range: tuple[float, float],
    ):
        self.depth_range = depth_range
        self.camera, self.radius, self.kind = camera, radius, kind
        self.points = (np.asarray(positions, np.float64) - camera.eye) @ camera.pose[:, :3]
        x, y, z = self.points.T
        self.column, self.row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        self.range = np.linalg.norm(self.points, axis=1)
        # half as wide again: far from the axis, pixels see more than a circle
        self.window = 1 + 1.5 * max(LEAST_RADIUS, radius * max(camera.fx, camera.fy) / z.min())

    def hits(self, column: int, row: int) -> Hits | None:
        """(points (S,), closeness (S,), depth (S,)) of a pixel, or None where float32's rounding
        may decide over a hit.
        """
        camera, radius = self.camera, self.radius
        near = (np.abs(self.column - column - 0.5) < self.window) & (
            np.abs(self.row - row - 0.5) < self.window
        )
        points = np.flatnonzero(near)
        c, t = self.points[points], self.range[points]
        ray = np.array(
            [(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1]
        )
        ray /= np.linalg.norm(ray)
        rho = np.linalg.norm(c - t[:, None] * ray, axis=1)
        width = t / min(camera.fx, camera.fy)
        least = LEAST_RADIUS * width
        edges = (
            [np.maximum(radius, least)] if self.kind == "disc" else [np.full_like(t, radius), least]
        )
        if any((np.abs(rho - edge) < ROUNDING * t).any() for edge in edges):
            return None
        hit = (rho < edges[0]) | (rho < edges[-1])
        closeness, depth = np.ones_like(rho), t
        if self.kind == "sphere":
            closeness = np.where(
                (rho < least) & (radius < width), 1.0, np.clip(1 - rho / radius, 0, 1)
            )
            along = np.minimum(c @ ray, t)
            across = np.linalg.norm(c - along[:, None] * ray, axis=1)
            depth = along - np.sqrt(np.maximum(radius**2 - across**2, 0))
        return points[hit], closeness[hit], depth[hit]

    def features(
        self, hits: Hits, opacity: np.ndarray, point_features: np.ndarray, gamma: float
    ) -> np.ndarray:
        """(C,) blended features of hits(); opacity: (S,), point_features: (S, C) of these points;
        the background is 1.
        """
        _, closeness, depth = hits
        near, far = self.depth_range
        z = 1 - (depth - near) / (far - near)
        exponent = np.append(opacity * z / gamma, EPS / gamma)
        weight = np.append(opacity * closeness, 1.0) * np.exp(exponent - exponent.max())
        return (
            weight
            / weight.sum()
            @ np.vstack([point_features, np.ones((1, point_features.shape[1]))])
        )

    def composited(self, hits: Hits, opacity: np.ndarray, point_features: np.ndarray) -> np.ndarray:
        """(C,) features of hits() composited from front to back, otherwise as features()."""
        points, closeness, depth = hits
        result, through = np.zeros(point_features.shape[1]), 1.0
        for i in np.lexsort((points, depth)):
            alpha = float(opacity[i]) * closeness[i]
            result += through * alpha * point_features[i]
            through *= 1 - alpha
        return result + through


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """(N, 9) real harmonics of degrees 0 to 2 of unit directions (N, 3), as cl/sh.h orders them."""
    x, y, z = np.asarray(directions, np.float64).T
    first, second = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    return np.stack(
        [
            np.full_like(x, 0.5 / np.sqrt(np.pi)),
            -first * y,
            first * z,
            -first * x,
            second * x * y,
            -second * y * z,
            np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1),
            -second * x * z,
            0.5 * second * (x * x - y * y),
        ],
        -1,
    )
