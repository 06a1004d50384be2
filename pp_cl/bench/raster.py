"""`pp-cl bench raster`: times and errors of the rasteriser's stages, with both blends in turn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from pp_cl.bench.spheres import find_all_pairs, project_spheres, spheres_backward
from pp_cl.bench.timing import interleave
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.buffers import Buffers, gather_rows
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.blend import blend_backward, blend_forward
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.raster.weights import blend_weights
from pp_cl.engine.render import Renderer, RenderResult
from pp_cl.reference import dense
from pp_cl.settings import RasterConfig

BLENDS = ("alpha", "softmax")
GAMMA = 0.01  # depth sharpness: a training's last and sharpest
RADIUS = 0.0015  # world units, as in the paper and in Pulsar
CHECKED_POINTS, CHECKED_SIDE = 4000, 16
# float32's error in the distance from a ray, as a share of the range
ROUNDING = 4 * np.finfo(np.float32).eps
CHANNELS = 16
# every coefficient of degrees 1 and 2; random ones would take minutes for 4 million points
HIGHER_SH = 0.1


class GridScene:
    """About n discs of the paper's radius on a grid inside the unit ball, seen along none of its
    axes, under 40 degrees. positions: (N, 3). opacity: (N,) in [0.7, 1], as in a trained model.
    """

    footprint, depth_range = "disc", (2.0, 6.0)

    def __init__(self, dev: Device, n: int, size: int):
        rng = np.random.default_rng(0)
        self.grad = dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32))
        voxel_size = (4 / 3 * np.pi / n) ** (1 / 3)
        side = int(2 / voxel_size) + 2
        grid = Grid((-voxel_size * (side - 1) / 2,) * 3, voxel_size, (side,) * 3)
        squares = (grid.origin[0] + voxel_size * np.arange(side)) ** 2
        inside = squares[:, None, None] + squares[:, None] + squares < 1
        ids = np.flatnonzero(inside).astype(np.uint32)
        self.positions, n = grid.positions(ids), len(ids)
        focal = size / (2 * np.tan(np.radians(20)))
        eye = 2.4, -1.6, np.sqrt(16 - 2.4**2 - 1.6**2)
        self.camera = Camera.look_at(eye, (0, 0, 0), fx=focal, width=size, height=size)

        net = UNet(dev, widths=(CHANNELS,) * 3)
        self.opacity = rng.uniform(0.7, 1, n).astype(np.float32)
        self.cloud = PointCloud.create(dev, ids, opacity=self.opacity)
        model = Model(dev, grid, self.depth_range, self.cloud, net=net)
        self.sh_0 = rng.standard_normal((n, 1, CHANNELS), np.float32)
        self.cloud.sh[0].set(self.sh_0)
        for coefficients in self.cloud.sh[1:]:
            dev.fill(coefficients, HIGHER_SH)
        disc = RasterConfig(footprint="disc", radius=RADIUS, early_stop=0.0)
        self.renderers = {b: Renderer(dev, model, replace(disc, blend=b)) for b in BLENDS}

    def forward(self, blend: str) -> RenderResult:
        """Project, find pairs, weigh, shade and blend."""
        return self.renderers[blend].forward(self.camera, GAMMA, until="features", training=True)

    def backward(self, blend: str, result: RenderResult) -> None:
        """Stage `backward`: gradients of features and opacities."""
        self.renderers[blend].backward_features(result, self.grad)

    def exact_features(self) -> np.ndarray:
        """(N, 16) float64 features of the points, shaded."""
        coefficients = np.full((len(self.positions), 9, CHANNELS), HIGHER_SH)
        coefficients[:, :1] = self.sh_0
        return dense.shade(self.positions, self.camera.eye, coefficients)


class PulsarScene:
    """The scene of Pulsar's own benchmark: n opaque spheres in a cube at a depth of 1 to 2."""

    footprint, depth_range = "sphere", (0.6, 2.5)

    def __init__(self, dev: Device, n: int, size: int):
        rng = np.random.default_rng(0)
        self.dev, self.size = dev, (size, size)
        self.grad = dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32))
        self.camera = Camera(np.eye(3, 4), size, size, size / 2, size / 2, size, size)
        self.opacity = np.ones(n, np.float32)
        self.positions = rng.random((n, 3), np.float32) + np.array([-0.5, -0.5, 1], np.float32)
        self.point_features = rng.random((n, CHANNELS), np.float32)
        self.buffers, self.capacity = {blend: Buffers(dev) for blend in BLENDS}, 1
        self.camera_buffer = dev.upload(self.camera.packed(self.depth_range))
        self.point_radius = dev.upload(np.full(n, RADIUS), np.float32)
        self.point_positions, self.point_opacity = map(dev.upload, (self.positions, self.opacity))
        self.device_features = dev.upload(self.point_features)
        self.features = dev.empty((size, size, CHANNELS))

    def forward(self, blend: str) -> RenderResult:
        """Project, find pairs, weigh and blend."""
        dev, b, camera, size = self.dev, self.buffers[blend], self.camera_buffer, self.size
        with dev.stage("project"):
            points = project_spheres(
                dev, b, self.footprint, camera, self.point_positions, point_radius=self.point_radius
            )
        with dev.stage("pairs"):
            pairs = find_all_pairs(dev, b, points, size, self.capacity)
            self.capacity = pairs.capacity
        with dev.stage("weights"):
            opacity = self.point_opacity
            weights = blend_weights(dev, b, points, pairs, opacity, blend=blend, gamma=GAMMA)
            weights.read_count(dev)
        with dev.stage("blend"):
            features = gather_rows(dev, self.device_features, weights.visible)
            blend_forward(dev, b, pairs, weights, features, self.features)
        result = RenderResult(dev, self.camera, (0, 0), size, points, pairs, weights, None)
        result.visible_features, result.features = features, self.features
        return result

    def backward(self, blend: str, result: RenderResult) -> None:
        """Gradients of features and opacities, then of positions and radii."""
        dev, opacity = self.dev, self.point_opacity
        view = result.points, result.pairs, result.weights
        with dev.stage("backward"):
            gradients = blend_backward(
                dev,
                self.buffers[blend],
                *view,
                visible_features=result.visible_features,
                features=result.features,
                grad_features=self.grad,
            )
        with dev.stage("spheres"):
            spheres_backward(dev, *view, gradients.pair_gradient, opacity=opacity, gamma=GAMMA)

    def exact_features(self) -> np.ndarray:
        """(N, 16) float64 features of the points."""
        return self.point_features.astype(np.float64)


Scene = GridScene | PulsarScene
SCENES: dict[str, type[Scene]] = {"grid": GridScene, "pulsar": PulsarScene}


def features_error(scene: Scene, blend: str, features: np.ndarray) -> float:
    """Largest difference of an image's (H, W, 16) features from float64, over the range of the
    points' features and the background. Pixels where rounding may decide on a fragment do not
    count.
    """
    geometry = dense.geometry(
        scene.camera, scene.positions, RADIUS, scene.footprint, depth_range=scene.depth_range
    )
    clear = (geometry["margin"] >= ROUNDING * scene.camera.fx).all(axis=0)
    point_features = scene.exact_features()
    exact = dense.blend_by_rule(blend, geometry, scene.opacity, GAMMA)
    expected = dense.features(exact, point_features)
    span = np.maximum(point_features.max(0), 1) - np.minimum(point_features.min(0), 1)
    difference = np.abs(features.reshape(expected.shape) - expected) / span
    return float(difference[clear].max(initial=0))


def bench_raster(
    dev: Device, name: str, points: list[int], sizes: list[int], *, blends: Sequence[str] = BLENDS
) -> Iterator[dict]:
    """Yield a row for every number of points, side and blend. name: a key of SCENES."""
    small = SCENES[name](dev, CHECKED_POINTS, CHECKED_SIDE)
    errors = {b: features_error(small, b, small.forward(b).features.get()) for b in blends}
    for n, size in product(points, sizes):
        before = dev.reset_peak()
        scene = SCENES[name](dev, n, size)
        # of the stages in each pass
        seconds: dict[str, list[dict]] = {blend: [] for blend in blends}

        def run(blend, scene=scene, seconds=seconds):
            with dev.timed_stages() as stages:
                scene.backward(blend, scene.forward(blend))
            seconds[blend].append(stages)

        for blend, times in interleave({b: partial(run, b) for b in blends}).items():
            passes = seconds[blend][1:]  # the first one builds programs
            stages = {
                stage: float(np.median([sum(taken[stage]) for taken in passes])) * 1e3
                for stage in passes[0]
            }
            backward = sum(stages.get(stage, 0) for stage in ("backward", "spheres"))
            result = scene.forward(blend)
            yield {
                "scene": name,
                "points": len(scene.positions),
                "size": size,
                "gamma": GAMMA,
                "blend": blend,
                "pairs": result.pairs.total,
                "visible": int(result.weights.visible.size),
                "forward_ms": sum(stages.values()) - backward,
                "backward_ms": backward,
                "ms": float(np.median(times)),
                "ms_range": [min(times), max(times)],
                "stages_ms": stages,
                "peak_device_bytes": dev.peak_bytes - before,
                "max_err": errors[blend],
            }
