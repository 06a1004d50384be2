"""`pp-cl bench raster`: times and errors of the rasteriser's stages, with both blends in turn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from pp_cl.bench.timing import interleave
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.render import PAPER_DEPTH_RANGE, Renderer, RenderResult
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


class Scene:
    """Discs of the paper's radius, and the stages that render them. positions: (N, 3). opacity:
    (N,). sh_0: (N, 1, 16) float32, SH coefficients of degree 0; those above are HIGHER_SH.
    """

    depth_range: tuple[float, float]
    camera: Camera
    positions: np.ndarray
    opacity: np.ndarray

    def build(self, dev: Device, grid: Grid, cloud: PointCloud, radius: float, size: int) -> None:
        """Make the model and its renderers. radius: as raster.radius has it."""
        rng = np.random.default_rng(1)
        self.grad = dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32))
        net = UNet(dev, widths=(CHANNELS,) * 3)
        model = Model(dev, grid, self.depth_range, cloud, net=net)
        self.sh_0 = rng.standard_normal((cloud.count, 1, CHANNELS), np.float32)
        cloud.sh[0].set(self.sh_0)
        for coefficients in cloud.sh[1:]:
            dev.fill(coefficients, HIGHER_SH)
        disc = RasterConfig(footprint="disc", radius=radius, early_stop=0.0)
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


class GridScene(Scene):
    """About n points on a grid inside the unit ball, seen along none of its axes, under 40 degrees,
    with opacities in [0.7, 1], as in a trained model.
    """

    depth_range = 2.0, 6.0

    def __init__(self, dev: Device, n: int, size: int):
        rng = np.random.default_rng(0)
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

        self.opacity = rng.uniform(0.7, 1, n).astype(np.float32)
        self.build(dev, grid, PointCloud.create(dev, ids, opacity=self.opacity), RADIUS, size)


class PulsarScene(Scene):
    """The places of Pulsar's own benchmark: n opaque points in a cube at a depth of 1 to 2; here
    they are discs of the radius of its spheres.
    """

    depth_range = 0.6, 2.5

    def __init__(self, dev: Device, n: int, size: int):
        rng = np.random.default_rng(0)
        self.camera = Camera(np.eye(3, 4), size, size, size / 2, size / 2, size, size)
        self.opacity = np.ones(n, np.float32)
        self.positions = rng.random((n, 3), np.float32) + np.array([-0.5, -0.5, 1], np.float32)
        grid = Grid((0.0, 0.0, 0.0), 4.0, (1, 1, 1))  # all lie in its one cell
        cloud = PointCloud.create(dev, np.zeros(n, np.uint32), opacity=self.opacity)
        cloud.offset.set(np.pad(self.positions / np.float32(grid.voxel_size), ((0, 0), (0, 1))))
        near, far = self.depth_range
        self.build(dev, grid, cloud, RADIUS * PAPER_DEPTH_RANGE / (far - near), size)


SCENES: dict[str, type[GridScene] | type[PulsarScene]] = {"grid": GridScene, "pulsar": PulsarScene}


def features_error(scene: Scene, blend: str, features: np.ndarray) -> float:
    """Largest difference of an image's (H, W, 16) features from float64, over the range of the
    points' features and the background. Pixels where rounding may decide on a fragment do not
    count.
    """
    geometry = dense.geometry(
        scene.camera, scene.positions, RADIUS, "disc", depth_range=scene.depth_range
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
            backward = stages["backward"]
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
