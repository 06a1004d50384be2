"""Runs the rasteriser's stages on explicit points, for the tests: what render.py does, with every
intermediate at hand.
"""

import numpy as np
from oracle import raster as oracle

from pp_cl.raster.blend import Blend
from pp_cl.raster.blend_weights import Weights
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.project import Footprint, Projection
from pp_cl.scene.camera import Camera


def look_at(eye, target):
    """(3, 4) float64 pose of a camera at `eye` that looks at `target`, world z up."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, eye], 1)


def make_camera(width=24, height=20, focal=30.0):
    """A camera four units away from the origin, off the axes, with different focal lengths and an
    odd principal point.
    """
    return Camera(
        look_at([2.3, -2.6, 1.9], [0.0, 0.1, 0.0]),
        focal,
        focal * 1.1,
        width * 0.45,
        height * 0.55,
        width,
        height,
    )


def make_points(rng, n):
    """(N, 3) points around the origin; some lie outside the view, or nearer or farther than
    allowed.
    """
    return rng.normal(size=(n, 3)) * [0.9, 0.9, 0.8]


class Scene:
    """Points projected and paired with the pixels of a camera; arrays are float64 or float32 numpy.

    positions: (N, 3). radius: one number or (N,), world units.
    """

    def __init__(self, dev, camera, positions, radius, kind="soft"):
        self.dev, self.camera, self.n = dev, camera, len(positions)
        self.shape = (camera.height, camera.width)
        self.footprint = Footprint(kind)
        self.view = dev.upload(camera.packed())
        self.radius = dev.upload(np.atleast_1d(radius), np.float32)
        self.projection = Projection(dev, self.footprint)
        self.projection.spheres(self.view, dev.upload(positions, np.float32), self.radius)
        self.pairs = Pairs(dev, self.footprint)
        self.pairs.build(self.view, self.shape, self.projection, self.radius)

    def pair_points(self):
        """(P,) the point of each pair, from the offsets alone."""
        return np.repeat(np.arange(self.n), np.diff(self.pairs.point_offset.get().astype(np.int64)))

    def dense(self, pair_values, missing=0.0):
        """(N, HW) of values by pair: (P, ...) on the host."""
        total = self.pairs.total
        matrix = np.full(
            (self.n, self.camera.width * self.camera.height), missing, pair_values.dtype
        )
        matrix[self.pair_points(), self.pairs.pair_pixel.get()[:total]] = pair_values[:total]
        return matrix

    def hits(self):
        """(N, HW) bool."""
        return self.dense(np.ones(max(1, self.pairs.total), bool), False)

    def blend(self, opacity, gamma, point_features, mean=False, max_tracked=0, stop=0.0, tau=0.0):
        """(H, W, 16) blended features; those of the points that are not kept are set to NaN
        first.
        """
        self.gamma, self.opacity = gamma, self.dev.upload(opacity, np.float32)
        self.weights, self.blending = Weights(self.dev), Blend(self.dev, self.footprint, mean)
        self.weights.weigh(self.pairs, self.view, self.opacity, gamma, max_tracked, stop, tau)
        kept = np.isin(np.arange(self.n), self.weights.kept.get())
        self.point_features = self.dev.upload(
            np.where(kept[:, None], point_features, np.nan), np.float32
        )
        self.features = self.dev.empty((*self.shape, 16))
        self.blending.forward(self.pairs, self.point_features, self.features)
        return self.features.get()

    def gradients(self, grad_features):
        """{"features": (N, 16), "opacity": (N,)} of sum(features * grad_features) after blend()."""
        grad_point_features, grad_opacity = self.dev.empty((self.n, 16)), self.dev.empty((self.n,))
        self.grad = self.dev.upload(np.reshape(grad_features, (*self.shape, 16)), np.float32)
        self.blending.backward(
            self.pairs,
            self.weights.pair_weight,
            self.point_features,
            self.features,
            self.grad,
            grad_point_features,
            grad_opacity,
        )
        return {"features": grad_point_features.get(), "opacity": grad_opacity.get()}

    def sphere_gradients(self, grad_features):
        """{"positions": (N, 3), "radius": (N,)} of the same."""
        grad_positions, grad_radius = self.dev.empty((self.n, 3)), self.dev.empty((self.n,))
        self.grad = self.dev.upload(np.reshape(grad_features, (*self.shape, 16)), np.float32)
        self.blending.backward_spheres(
            self.pairs,
            self.weights.pair_weight,
            self.view,
            self.gamma,
            self.radius,
            self.projection.point_camera,
            self.opacity,
            self.point_features,
            self.features,
            self.grad,
            grad_positions,
            grad_radius,
        )
        return {"positions": grad_positions.get(), "radius": grad_radius.get()}


GAMMAS = (0.1, 0.01)


class Blended:
    """A random scene blended by the kernels and by the oracle, both with the kernels' hits."""

    def __init__(
        self, dev, rng, n=257, kind="soft", gamma=0.1, radius=None, size=(24, 20), **blend
    ):
        self.camera, self.gamma, self.kind = make_camera(*size), gamma, kind
        self.positions = make_points(rng, n)
        self.radius = np.float32(
            rng.uniform(0.05, 0.5, n) if radius is None else np.full(n, radius)
        )
        self.opacity = np.float32(rng.uniform(0, 1, n))
        self.opacity[::7] = 0
        self.opacity[1::7] = 1
        self.point_features = rng.normal(size=(n, 16))
        self.grad = rng.normal(size=(size[0] * size[1], 16))
        self.scene = Scene(dev, self.camera, self.positions, self.radius, kind)
        self.features = self.scene.blend(self.opacity, gamma, self.point_features, **blend).reshape(
            -1, 16
        )
        self.geometry = oracle.geometry(self.camera, self.positions, self.radius, kind) | {
            "hit": self.scene.hits()
        }
        self.blend = oracle.blend(
            self.camera, self.geometry, self.opacity, gamma, blend.get("stop", 0.0)
        )
        self.weight = self.scene.dense(self.scene.weights.pair_weight.get()[:, 0])

    def gradients(self):
        """The kernels' gradients of sum(features * grad)."""
        return self.scene.gradients(self.grad)

    def oracle_gradients(self, max_tracked=0, mean=False):
        """The same by the oracle: (features, opacity, by pair and logit)."""
        return oracle.blend_gradients(
            self.geometry,
            self.blend,
            self.opacity,
            self.point_features,
            self.grad,
            self.gamma,
            max_tracked,
            mean,
        )
