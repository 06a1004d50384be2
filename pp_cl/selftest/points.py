"""Runs the rasteriser's stages on explicit points and gives access to all intermediate results."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pyopencl.array import Array

from pp_cl.engine.camera import Camera, look_at
from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.raster.blend import BlendGradients, blend_backward, blend_forward
from pp_cl.engine.raster.fragments import Fragments, list_fragments
from pp_cl.engine.raster.pairs import Pairs, capacity_needed, find_pairs
from pp_cl.engine.raster.points import OPACITIES
from pp_cl.engine.raster.project import ProjectedPoints, project_grid
from pp_cl.engine.raster.weights import BlendWeights, blend_weights
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


def find_all_pairs(
    dev: Device,
    b: Buffers,
    points: ProjectedPoints,
    size: tuple[int, int],
    times_seen: Array | None = None,
) -> Pairs:
    """find_pairs() by point, with room for all pairs."""
    capacity = 1
    while True:
        pairs = find_pairs(dev, b, points, size, capacity, times_seen, by_point=True)
        pairs.read_count(dev)
        capacity = capacity_needed(pairs)
        if capacity == pairs.capacity:
            return pairs
        del pairs  # frees its arrays before the larger ones are made


class PairedPoints:
    """Points (N, 3) with one radius or (N,), projected and paired with the tiles of a camera's
    image, or of one of pixels with several samples. exact(): dense.geometry() of them.
    """

    weights: BlendWeights  # from the last blend()
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
        supersampling: int = 1,
    ):
        n, largest = len(positions), float(np.max(radius))
        exact = partial(dense.geometry, camera, positions, kind=kind, depth_range=depth_range)
        exact = partial(exact, radius=radius)
        if kind == "gaussian":  # culled by their common radius
            spread = np.square(np.broadcast_to(radius, n).astype(np.float64))[:, None, None]
            exact = partial(exact, radius=largest, covariance=spread * np.eye(3))
        offset = np.zeros((n, 16 if kind == "gaussian" else 4), np.float32)
        # all lie in one cell, whose size divides without a rounding
        near = np.abs(positions)[np.abs(positions) < 1e6].max(initial=1)
        size = 2.0 ** np.ceil(np.log2(2 * near))
        offset[:, :3] = np.asarray(positions, np.float32) / np.float32(size)
        with np.errstate(divide="ignore", invalid="ignore"):
            if np.ndim(radius):
                offset[:, 3] = np.log(np.asarray(radius, np.float64) / largest)
            if kind == "gaussian":
                offset[:, 4] = offset[:, 5] = offset[:, 3]
        grid = Grid((0.0, 0.0, 0.0), float(size), (1, 1, 1))
        ids = np.zeros(n, np.uint32)
        view = depth_range, grid, ids, offset, largest
        self._set(dev, camera, kind, supersampling, exact, *view)

    def _set(self, dev, camera, kind, supersampling, exact, depth_range, grid, ids, offset, radius):
        self.dev, self.camera, self.n, self.buffers = dev, camera, len(ids), Buffers(dev)
        self.exact, self.depth_range = exact, depth_range
        self.shape = camera.height // supersampling, camera.width // supersampling
        self._view = kind, dev.upload(camera.packed(depth_range)), dev.upload(grid.packed())
        self._points = {
            "point_id": dev.upload(ids, np.uint32),
            "cloud_offset": dev.upload(offset, np.float32),
            "radius": radius,
            "supersampling": supersampling,
        }
        self._project(np.zeros(self.n))
        self.times_seen = dev.zeros((self.n,))
        shared = dev, self.buffers, self.projected
        self.pairs = find_all_pairs(*shared, self.shape, self.times_seen)
        options = {"blend": "alpha", "gamma": 1.0, "early_stop": 0.0}
        weights = blend_weights(*shared, self.pairs, **options)
        #: all fragments, of which none is opaque
        self.listed: Fragments = list_fragments(dev, self.projected, self.pairs, weights)

    def _project(self, opacity):
        opacities = np.zeros((self.n, OPACITIES), np.float32)
        opacities[:, 0] = opacity
        of_points = self._points | {"opacity": self.dev.upload(opacities)}
        self.projected = project_grid(self.dev, self.buffers, *self._view, **of_points)

    @property
    def seen(self) -> np.ndarray:
        """(?,) indices of the points that have a fragment, ascending."""
        return np.unique(self.listed.point)

    def dense(self, values: np.ndarray, missing: float = 0.0) -> np.ndarray:
        """(N, HW) array of the values of the fragments as listed."""
        matrix = np.full((self.n, self.shape[0] * self.shape[1]), missing, values.dtype)
        matrix[self.listed.point, self.listed.pixel] = values
        return matrix

    def depths(self) -> np.ndarray:
        """(N,) float32, the depths by which points are sorted; 0 for points without pairs."""
        keys = self.pairs.pair_key.get()[: self.pairs.total]
        depths = np.zeros(self.n, np.float32)
        depths[keys & 0xFFFFFFFF] = (keys >> 32).astype(np.uint32).view(np.float32)
        return depths

    def geometry(self) -> dict[str, np.ndarray]:
        """dense.geometry() with the device's fragments, falloff and depth, since a falloff at the
        rim of a footprint is rounding, which a softmax may turn into half a pixel.
        """
        fragment, geometry = self.fragments(), self.exact()
        falloff, depth = self.dense(self.listed.falloff), self.depths()[:, None]
        for name, measured in (("falloff", falloff), ("depth", depth)):
            geometry[name] = np.where(fragment, measured, geometry[name])
        near, far = self.depth_range
        return geometry | {"fragment": fragment, "z": 1 - (geometry["depth"] - near) / (far - near)}

    def fragments(self) -> np.ndarray:
        """(N, HW) bool: the pixels that each point covers."""
        return self.dense(np.ones(len(self.listed.point), bool), False)

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
        self.gamma, self.opacity = gamma, np.asarray(opacity, np.float32)
        self._project(self.opacity)
        view = self.projected, self.pairs
        options = {"blend": rule, "gamma": gamma, **drops}
        self.weights = blend_weights(self.dev, self.buffers, *view, **options)
        self.weights.read_count(self.dev)
        self.blended = list_fragments(self.dev, *view, self.weights)
        visible = self.weights.visible.get()
        rows = np.full((len(visible) + 1, 16), np.nan)  # with room for one more point
        rows[:-1] = np.asarray(point_features)[visible]
        self.visible_features = self.dev.upload(rows, np.float32)
        self.features = self.dev.empty((*self.shape, 16))
        arrays = self.visible_features, self.features
        blend_forward(self.dev, Buffers(self.dev), *view, self.weights, *arrays)
        return self.features.get()

    def weight(self) -> np.ndarray:
        """(N, HW) blend weights, 0 for dropped fragments."""
        return self.dense(self.blended.weight)

    def dropped(self) -> np.ndarray:
        """(N, HW) bool: the fragments behind an early stop, and Gaussians' that hardly show."""
        return self.dense(~self.blended.shows, False)

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
        vertices = grid.positions(ids)
        exact = partial(dense.gaussians, camera, vertices, grid.voxel_size, offset, radius)
        view = dense.DEPTH_RANGE, grid, ids, offset, radius
        self._set(dev, camera, "gaussian", 1, exact, *view)


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
        self.weight, self.dropped = self.scene.weight(), self.scene.dropped()

    def gradients(self, distortion_weight: float = 0.0) -> Gradients:
        """The kernels' gradients of sum(features * grad) and the weighted distortion loss."""
        return self.scene.gradients(self.grad, distortion_weight=distortion_weight)

    def reference_gradients(self, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        """(features, opacity) gradients in float64. options: as for dense.gradients()."""
        return dense.gradients(self.geometry, self.blend, self.point_features, self.grad, **options)
