"""Runs the rasteriser's stages on explicit points and gives access to all intermediate results."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pyopencl.array import Array

from pp_cl.bench.spheres import find_all_pairs, project_spheres, spheres_backward
from pp_cl.engine.camera import Camera, look_at
from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.raster.blend import BlendGradients, blend_backward, blend_forward
from pp_cl.engine.raster.points import OPACITIES
from pp_cl.engine.raster.project import project_grid
from pp_cl.engine.raster.weights import blend_weights, listed_fragments
from pp_cl.reference import dense

Gradients = dict[str, np.ndarray]


def make_camera(width: int = 24, height: int = 20, focal: float = 30.0) -> Camera:
    """A camera four units away, off the axes, with two focal lengths and an odd principal point."""
    pose = look_at([2.3, -2.6, 1.9], [0.0, 0.1, 0.0])
    return Camera(pose, focal, 1.1 * focal, 0.45 * width, 0.55 * height, width, height)


def make_points(rng: np.random.Generator, n: int) -> np.ndarray:
    """(N, 3) points around the origin; some lie outside the view or the depth range."""
    return rng.normal(size=(n, 3)) * [0.9, 0.9, 0.8]


def some_ids(rng: np.random.Generator, grid: Grid, n: int) -> np.ndarray:
    """(n,) uint32 ascending ids of n vertices of a grid."""
    return np.sort(rng.choice(grid.ids_of(np.ones(grid.dims[::-1], bool)), n, replace=False))


def some_opacities(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 9) float32 opacities of a PointCloud, random within their bounds."""
    least = np.repeat([0.0, -1.0], (1, OPACITIES - 1))
    return rng.uniform(least, 1, (n, OPACITIES)).astype(np.float32)


class PairedPoints:
    """Points (N, 3) with one radius or (N,), projected and paired with a camera's pixels, or with
    pixels of side x side samples.
    """

    backward: BlendGradients  # from the last gradients()

    def __init__(
        self,
        dev: Device,
        camera: Camera,
        positions: np.ndarray,
        radius: np.ndarray | float,
        *,
        kind: str = "soft",
        depth_range: tuple[float, float] = dense.DEPTH_RANGE,
        side: int = 1,
    ):
        exact = partial(dense.geometry, camera, positions, radius, kind, depth_range=depth_range)
        buffers, n = Buffers(dev), len(positions)
        projected = project_spheres(
            dev,
            buffers,
            kind,
            dev.upload(camera.packed(depth_range)),
            dev.upload(positions, np.float32),
            point_radius=dev.upload(np.broadcast_to(radius, n), np.float32),
            side=side,
        )
        self._pair(dev, camera, n, exact, depth_range, buffers, projected)

    def _pair(self, dev, camera, n, exact, depth_range, buffers, projected):
        self.dev, self.camera, self.n, self.buffers = dev, camera, n, buffers
        self._exact, self.depth_range = exact, depth_range
        self.shape = camera.height // projected.side, camera.width // projected.side
        self.projected = projected
        self.times_seen = dev.zeros((n,))
        self.pairs = find_all_pairs(dev, buffers, projected, self.shape, times_seen=self.times_seen)

    @property
    def seen(self) -> np.ndarray:
        """(?,) indices of the points that have a pair, ascending."""
        return np.flatnonzero(np.diff(self.pairs.point_offset.get()))

    def pair_points(self) -> np.ndarray:
        """(P,) the point of each pair, computed from the offsets alone."""
        counts = np.diff(self.pairs.point_offset.get().astype(np.int64))
        return np.repeat(np.arange(self.n), counts)

    def dense(self, pair_values: np.ndarray, missing: float = 0.0) -> np.ndarray:
        """(N, HW) array of the pairs' values, (P, ...) on the host."""
        total = self.pairs.total
        pixels = self.camera.width * self.camera.height
        matrix = np.full((self.n, pixels), missing, pair_values.dtype)
        matrix[self.pair_points(), self.pairs.pair_pixel.get()[:total]] = pair_values[:total]
        return matrix

    def geometry(self) -> dict[str, np.ndarray]:
        """dense.geometry() with the device's fragments, falloff and depth, since a falloff at the
        rim of a footprint is rounding, which a softmax may turn into half a pixel.
        """
        total, fragment = self.pairs.total, self.fragments()
        falloff = self.pairs.pair_point_falloff.get()[:total, 1].view(np.float32)
        keys, depth = self.pairs.pair_key.get()[:total], np.empty(total, np.float32)
        depth[keys & 0xFFFFFFFF] = (keys >> 32).astype(np.uint32).view(np.float32)
        geometry = self._exact()
        for name, measured in (("falloff", falloff), ("depth", depth)):
            geometry[name] = np.where(fragment, self.dense(measured), geometry[name])
        near, far = self.depth_range
        return geometry | {"fragment": fragment, "z": 1 - (geometry["depth"] - near) / (far - near)}

    def fragments(self) -> np.ndarray:
        """(N, HW) bool: the pixels that each point covers."""
        return self.dense(np.ones(max(1, self.pairs.total), bool), False)

    def blend(
        self,
        opacity: ArrayLike,
        gamma: float,
        point_features: np.ndarray,
        *,
        rule: str = "softmax",
        **drops: Any,
    ) -> np.ndarray:
        """(H, W, 16) blended features. rule: one of BLENDS. drops: max_tracked and early_stop."""
        self.gamma, self.opacity = gamma, self.dev.upload(opacity, np.float32)
        view = self.buffers, self.projected, self.pairs
        self.weights = blend_weights(
            self.dev, *view, self.opacity, blend=rule, gamma=gamma, **drops
        )
        self.weights.read_count(self.dev)
        visible = self.weights.visible.get()
        rows = np.full((len(visible) + 1, 16), np.nan)  # with room for one more point
        rows[:-1] = np.asarray(point_features)[visible]
        self.visible_features = self.dev.upload(rows, np.float32)
        self.features = self.dev.empty((*self.shape, 16))
        blended = self.pairs, self.weights, self.visible_features, self.features
        blend_forward(self.dev, Buffers(self.dev), *blended)
        return self.features.get()

    def weight(self) -> np.ndarray:
        """(N, HW) blend weights, 0 for dropped fragments."""
        return self.weight_and_dropped()[0]

    def weight_and_dropped(self) -> tuple[np.ndarray, np.ndarray]:
        """((N, HW) blend weights, (N, HW) bool: the fragments behind an early stop)."""
        is_listed, _, weights = listed_fragments(self.pairs, self.weights)
        ordered = self.pairs.pair_key.get()[: self.pairs.total] & np.uint64(0xFFFFFFFF)
        weight, dropped = np.zeros(len(ordered), np.float32), np.empty(len(ordered), bool)
        weight[ordered[is_listed]] = weights
        dropped[ordered] = ~is_listed
        return self.dense(weight), self.dense(dropped, False)

    def gradients(
        self,
        grad_features: np.ndarray,
        grad_alpha: np.ndarray | None = None,
        distortion_weight: float = 0.0,
        depth_gradient: Array | None = None,
        voxel_size: float = 0.0,
        max_weight: Array | None = None,
    ) -> Gradients:
        """{"features": (N, 16), "opacity": (N,), and if a voxel size is given "offset": (N, 4)}:
        gradients of sum(features * grad_features), sum(alpha * grad_alpha), the weighted
        distortion loss and the loss of depth_gradient.
        """
        grad_features = np.reshape(grad_features, (*self.shape, 16))
        view = self.projected, self.pairs, self.weights
        backward = self.backward = blend_backward(
            self.dev,
            self.buffers,
            *view,
            visible_features=self.visible_features,
            features=self.features,
            grad_features=self.dev.upload(grad_features, np.float32),
            grad_alpha=None if grad_alpha is None else self.dev.upload(grad_alpha, np.float32),
            distortion_weight=distortion_weight,
            depth_gradient=depth_gradient,
            voxel_size=voxel_size,
            max_weight=max_weight,
        )
        rows = {"features": backward.visible_features, "opacity": backward.opacity}
        if backward.offset is not None:
            rows["offset"] = backward.offset
        visible, gradients = self.weights.visible.get(), {}
        for name, array in rows.items():  # rows of visible points; all other points have 0
            gradients[name] = np.zeros((self.n, *array.shape[1:]), np.float32)
            gradients[name][visible] = array.get()[: len(visible)]
        return gradients

    def sphere_gradients(self, grad_features: np.ndarray) -> Gradients:
        """gradients(), and {"positions": (N, 3), "radius": (N,)} of sum(features * grad)."""
        gradients, view = self.gradients(grad_features), (self.projected, self.pairs, self.weights)
        pair_gradient = self.backward.pair_gradient
        positions, radius = spheres_backward(
            self.dev, *view, pair_gradient, opacity=self.opacity, gamma=self.gamma
        )
        return gradients | {"positions": positions.get(), "radius": radius.get()}


class PairedGaussians(PairedPoints):
    """Gaussians in the cells of a grid. ids: (N,). offset: (N, 16), as in cl/cloud.h."""

    def __init__(
        self,
        dev: Device,
        camera: Camera,
        grid: Grid,
        ids: np.ndarray,
        offset: np.ndarray,
        radius: float,
    ):
        vertices, n, buffers = grid.positions(ids), len(ids), Buffers(dev)
        exact = partial(dense.gaussians, camera, vertices, grid.voxel_size, offset, radius)
        projected = project_grid(
            dev,
            buffers,
            "gaussian",
            dev.upload(camera.packed(dense.DEPTH_RANGE)),
            dev.upload(grid.packed()),
            point_id=dev.upload(ids, np.uint32),
            cloud_offset=dev.upload(offset, np.float32),
            opacity=dev.zeros((n, OPACITIES)),
            radius=radius,
        )
        self._pair(dev, camera, n, exact, dense.DEPTH_RANGE, buffers, projected)


NEAR, FAR = dense.DEPTH_RANGE
AXIS_RADIUS = 0.001  # radius of points on the axis, world units
# a camera of one pixel that looks along z from the origin
AXIS = replace(make_camera(1, 1), pose=np.eye(3, 4), fx=100.0, fy=100.0, cx=0.5, cy=0.5)


def blend_on_axis(
    dev: Device, z: Sequence[float] | np.ndarray, opacity: ArrayLike, gamma: float, **options: Any
) -> tuple[PairedPoints, np.ndarray]:
    """(PairedPoints, weights) of points at normalised depths z in front of a one-pixel camera, each
    with its own channel.
    """
    positions = np.zeros((len(z), 3))
    positions[:, 2] = FAR - np.asarray(z) * (FAR - NEAR)
    scene = PairedPoints(dev, AXIS, positions, AXIS_RADIUS)
    scene.blend(np.asarray(opacity), gamma, np.eye(16)[np.arange(len(z)) % 16], **options)
    return scene, scene.weight()[:, 0]


class Blended:
    """A random scene blended by the kernels and in float64, with the kernels' geometry()."""

    def __init__(
        self,
        dev: Device,
        rng: np.random.Generator,
        n: int = 257,
        *,
        kind: str = "soft",
        gamma: float = 0.1,
        radius: float | None = None,
        size: tuple[int, int] = (24, 20),
        rule: str = "softmax",
        **blend: Any,
    ):
        self.camera, self.gamma, self.kind, self.rule = make_camera(*size), gamma, kind, rule
        self.positions = make_points(rng, n)
        radii = rng.uniform(0.05, 0.5, n) if radius is None else np.full(n, radius)
        self.radius = radii.astype(np.float32)
        self.opacity = rng.uniform(0, 1, n).astype(np.float32)
        self.opacity[::7] = 0
        self.opacity[1::7] = 1
        self.point_features = rng.normal(size=(n, 16))
        self.grad = rng.normal(size=(size[0] * size[1], 16))
        self.scene = PairedPoints(dev, self.camera, self.positions, self.radius, kind=kind)
        self.features = self.scene.blend(
            self.opacity, gamma, self.point_features, rule=rule, **blend
        ).reshape(-1, 16)
        self.geometry = self.scene.geometry()
        stop = blend.get("early_stop", 0.0)
        self.blend = dense.blend_by_rule(rule, self.geometry, self.opacity, gamma, stop)
        self.weight, self.dropped = self.scene.weight_and_dropped()

    def gradients(self, distortion_weight: float = 0.0) -> Gradients:
        """The kernels' gradients of sum(features * grad) and the weighted distortion loss."""
        return self.scene.gradients(self.grad, distortion_weight=distortion_weight)

    def reference_gradients(self, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        """(features, opacity) gradients in float64. options: as for dense.gradients()."""
        return dense.gradients(self.geometry, self.blend, self.point_features, self.grad, **options)
