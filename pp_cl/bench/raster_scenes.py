"""The scenes of `pp-cl bench raster`: made up, of any number of points, with float64 values of
sampled pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from pp_cl.bench.spheres import find_all_pairs, project_spheres, spheres_backward
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.buffers import Buffers, gather_rows
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.blend import blend_backward, blend_forward
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.raster.weights import BLENDS, blend_weights
from pp_cl.engine.render import Renderer, RenderResult
from pp_cl.reference import dense
from pp_cl.settings import RasterConfig

SAMPLES = 64  # pixels compared with float64
ROUNDING = 4 * np.finfo(np.float32).eps  # of the distance from a ray, in shares of the range
CHANNELS = 16
# every coefficient of degrees 1 and 2; random ones would take minutes for 4 million points
HIGHER_SH = 0.1


class BenchScene:
    """What the scenes share: float64 features of pixels.

    A scene has forward(blend) and backward(blend, result of the last forward), which rasterise it
    in stages (Device.stage), and exact_features(points), (S, 16) in float64.

    name: of the scene. forward_stages: the stages of forward(); those of backward() are timed
    beside them. size: side of the image in pixels. count: number of points. positions: (N, 3),
    world, all in view. radius: one number, world units, no more than a few pixels. opacity: (N,)
    float32. grad: (H, W, 16) device array, dL/dfeatures.
    """

    radius = 0.0015
    size: int
    count: int
    camera: Camera
    positions: np.ndarray
    opacity: np.ndarray
    gamma: float
    footprint: str
    depth_range: tuple[float, float]
    forward: Callable[[str], RenderResult]
    exact_features: Callable[[np.ndarray], np.ndarray]

    def error(self, blend: str, result: RenderResult) -> float:
        """Largest difference of the features from float64, at SAMPLES pixels that the object
        covers, over the range of the features of the shaded points and of the background, 1.

        Pixels where float32's rounding may decide over a hit are left out.
        """
        features, largest = result.features.get(), 0.0
        covered = np.flatnonzero(np.diff(result.pairs.pixel_offset.get().astype(np.int64)))
        rows = result.shaded_features.get()[: result.weights.shaded.size]
        span = np.maximum(rows.max(axis=0), 1) - np.minimum(rows.min(axis=0), 1)
        for pixel in np.random.default_rng(1).permutation(covered)[:SAMPLES]:
            row, column = divmod(int(pixel), self.size)
            expected = self.exact_pixel(blend, column, row)
            if expected is not None:
                difference = np.abs(features[row, column] - expected) / span
                largest = max(largest, float(difference.max()))
        return largest

    def exact_pixel(self, blend: str, column: int, row: int) -> np.ndarray | None:
        """(16,) float64 features of a pixel; None where float32's rounding may decide over a
        hit.
        """
        camera = self.camera
        x, y, z = self._camera_space
        # half as wide again: far from the axis, pixels see more than a circle
        window = 1 + 1.5 * max(dense.LEAST_RADIUS, self.radius * camera.fx / z.min())
        beside = np.abs(camera.fx * x / z + camera.cx - column - 0.5) < window
        near = np.flatnonzero(beside & (np.abs(camera.fy * y / z + camera.cy - row - 0.5) < window))
        geometry = dense.geometry(
            camera.crop(column, row, 1, 1),
            self.positions[near],
            self.radius,
            self.footprint,
            depth_range=self.depth_range,
        )
        if (geometry["margin"] < ROUNDING * camera.fx).any():
            return None
        exact = dense.blend_by_rule(blend, geometry, self.opacity[near], self.gamma)
        return dense.features(exact, self.exact_features(near))[0]

    @cached_property
    def _camera_space(self):
        return dense.camera_space(self.camera, self.positions).T


class GridScene(BenchScene):
    """About n discs of the paper's radius on a grid inside the unit ball, seen from a distance of 4
    under 40 degrees.

    Opacities are uniform in [0.7, 1]: in a trained model few are lower. The camera looks along no
    axis of the grid.
    """

    name, forward_stages = "grid", ("project", "pairs", "weights", "shade", "blend")
    footprint, depth_range = "disc", (2.0, 6.0)

    def __init__(self, dev: Device, n: int, size: int, gamma: float):
        rng = np.random.default_rng(0)
        edge = (4 / 3 * np.pi / n) ** (1 / 3)
        side = int(2 / edge) + 2
        grid = Grid((-edge * (side - 1) / 2,) * 3, edge, (side,) * 3)
        squares = (grid.origin[0] + edge * np.arange(side)) ** 2
        inside = squares[:, None, None] + squares[:, None] + squares < 1
        ids = np.flatnonzero(inside).astype(np.uint32)
        self.size, self.gamma, self.count = size, gamma, len(ids)
        axes, _ = np.linalg.qr([[0.9, 0.2, -0.4], [-0.3, 0.8, 0.5], [0.2, -0.5, 0.8]])
        axes[:, 2] *= np.linalg.det(axes)
        focal = size / (2 * np.tan(np.radians(20)))
        pose = np.concatenate([axes, -4 * axes[:, 2:]], 1)
        self.camera = Camera(pose, focal, focal, size / 2, size / 2, size, size)

        net = UNet(dev, widths=(CHANNELS,) * 3)
        model = Model(dev, grid, self.depth_range, PointCloud.create(dev, ids), net=net)
        self.opacity = rng.uniform(0.7, 1, self.count).astype(np.float32)
        self.sh_0 = rng.standard_normal((self.count, 1, CHANNELS), np.float32)
        model.cloud.opacity.set(self.opacity)
        model.cloud.sh[0].set(self.sh_0)
        for coefficients in model.cloud.sh[1:]:
            dev.fill(coefficients, HIGHER_SH)
        disc = RasterConfig(footprint="disc", radius=self.radius, early_stop=0.0)
        self.renderers = {
            blend: Renderer(dev, model, replace(disc, blend=blend)) for blend in BLENDS
        }
        self.grad = dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32))
        self.positions = grid.positions(ids)

    def forward(self, blend: str) -> RenderResult:
        """Project, find pairs, weigh, shade and blend, by the renderer."""
        renderer = self.renderers[blend]
        return renderer.forward(self.camera, self.gamma, until="features", training=True)

    def backward(self, blend: str, result: RenderResult) -> None:
        """Stage `backward`: gradients of features and opacities."""
        self.renderers[blend].backward_features(result, self.grad)

    def exact_features(self, points: np.ndarray) -> np.ndarray:
        """(S, 16) float64 features of some points, shaded."""
        coefficients = np.full((len(points), 9, CHANNELS), HIGHER_SH)
        coefficients[:, 0] = self.sh_0[points, 0]
        return dense.shade(self.positions[points], self.camera.eye, coefficients)


class PulsarScene(BenchScene):
    """Spheres of radius 0.0015, uniform in a cube of side 1 at a depth of 1 to 2: Pulsar's own
    benchmark.

    Focal length and sensor are equal, near is 0.6, far 2.5, opacities are 1. Stage `spheres`:
    gradients of positions and radii.
    """

    name, forward_stages = "pulsar", ("project", "pairs", "weights", "blend")
    footprint, depth_range = "sphere", (0.6, 2.5)

    def __init__(self, dev: Device, n: int, size: int, gamma: float):
        rng = np.random.default_rng(0)
        self.dev, self.size, self.gamma, self.count = dev, size, gamma, n
        self.camera = Camera(np.eye(3, 4), size, size, size / 2, size / 2, size, size)
        self.opacity = np.ones(n, np.float32)
        self.positions = rng.random((n, 3), np.float32) + np.array([-0.5, -0.5, 1], np.float32)
        self.point_features = rng.random((n, CHANNELS), np.float32)
        self.buffers, self.room = {blend: Buffers(dev) for blend in BLENDS}, 1
        self.camera_buffer = dev.upload(self.camera.packed(self.depth_range))
        self.point_radius = dev.upload(np.full(n, self.radius), np.float32)
        self.point_positions, self.point_opacity = map(dev.upload, (self.positions, self.opacity))
        self.device_features = dev.upload(self.point_features)
        self.features = dev.empty((size, size, CHANNELS))
        self.grad = dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32))

    def forward(self, blend: str) -> RenderResult:
        """Project, find pairs, weigh and blend."""
        dev, b, size = self.dev, self.buffers[blend], (self.size, self.size)
        with dev.stage("project"):
            points = project_spheres(
                dev,
                b,
                self.footprint,
                self.camera_buffer,
                self.point_positions,
                point_radius=self.point_radius,
            )
        with dev.stage("pairs"):
            pairs = find_all_pairs(dev, b, points, size, self.room)
            self.room = pairs.capacity
        with dev.stage("weights"):
            weights = blend_weights(
                dev,
                b,
                pairs,
                self.camera_buffer,
                self.point_opacity,
                blend=blend,
                gamma=self.gamma,
            )
        with dev.stage("blend"):
            features = gather_rows(dev, self.device_features, weights.shaded)
            blend_forward(dev, pairs, weights, features, self.features)
        result = RenderResult(dev, self.camera, (0, 0), size, points, pairs, weights, None)
        result.shaded_features, result.features = features, self.features
        return result

    def backward(self, blend: str, result: RenderResult) -> None:
        """Stages `backward` and `spheres`."""
        with self.dev.stage("backward"):
            gradients = blend_backward(
                self.dev,
                self.buffers[blend],
                result.points,
                result.pairs,
                result.weights,
                opacity=self.point_opacity,
                shaded_features=result.shaded_features,
                features=result.features,
                grad_features=self.grad,
            )
        with self.dev.stage("spheres"):
            spheres_backward(
                self.dev,
                result.points,
                result.pairs,
                result.weights,
                gradients.pair_gradient,
                opacity=self.point_opacity,
                gamma=self.gamma,
            )

    def exact_features(self, points: np.ndarray) -> np.ndarray:
        """(S, 16) float64 features of some points."""
        return self.point_features[points].astype(np.float64)


SCENES = {scene.name: scene for scene in (GridScene, PulsarScene)}
