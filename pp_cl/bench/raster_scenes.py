"""The scenes of `pp-cl bench raster`: made up, of any number of points, with float64 values of
sampled pixels.
"""

import numpy as np

from pp_cl.config import RasterConfig
from pp_cl.model import Model
from pp_cl.raster.blend import Blend
from pp_cl.raster.blend_weights import Weights
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.project import Footprint, Projection
from pp_cl.reference.raster import PixelReference
from pp_cl.render import Renderer
from pp_cl.scene.camera import Camera
from pp_cl.scene.grid import Grid

SAMPLES = 64  # pixels compared with float64
CHANNELS = 16
ROW = 4 * CHANNELS  # bytes of the features of a point or a pixel
# every coefficient of degrees 1 and 2; random ones would take minutes for 4 million points
HIGHER_SH = 0.1


class _Scene:
    """What the scenes have in common: names of the stages of `forward`, the tau of the next run,
    and what a run leaves.
    """

    _range = None  # of the features, once it has been computed

    def features(self, tau):
        """(H, W, 16) of all stages up to the blended features."""
        self.tau = tau
        for name, run in self.stages().items():
            if name in self.forward:
                run()
        return self.blended.get()

    def error(self, features):
        """Largest difference of features (H, W, 16) from float64 over their range, at SAMPLES
        pixels the object covers.

        Pixels where float32's rounding may decide over a hit are left out.
        """
        rng = np.random.default_rng(1)
        covered = np.flatnonzero(np.diff(self.pairs.pixel_offset.get().astype(np.int64)))
        largest, feature_range = 0.0, self.feature_range()
        for pixel in rng.permutation(covered)[:SAMPLES]:
            row, column = divmod(int(pixel), self.size)
            hits = self.reference.hits(column, row)
            if hits is not None:
                expected = self.reference.features(
                    hits, self.opacity[hits[0]], self.shaded(hits[0]), self.gamma
                )
                largest = max(
                    largest, float((np.abs(features[row, column] - expected) / feature_range).max())
                )
        return largest

    def feature_range(self):
        """(16,) largest minus smallest feature of the points kept in the first run asked for, and
        of the background, 1.
        """
        if self._range is None:
            rows = self.point_rows.get()[self.weights.kept.get()]
            self._range = np.maximum(rows.max(axis=0), 1) - np.minimum(rows.min(axis=0), 1)
        return self._range

    def moved(self):
        """{stage: bytes} that the stages run last had to read and write: every touched value of
        each kernel once.
        """
        n, p, hw, kept = self.count, self.pairs.total, self.size**2, self.weights.kept.size
        weights = self.weights.pair_weight.get()[:p]
        blended = p - int(np.signbit(weights).all(axis=1).sum())
        # of a point: place, box, number; of a pair: pixel, source, place or key
        search, pair = 16 + 8 + 4, 4 + 8 + 8
        return {
            # find twice, scan, scatter, sort
            "pairs": 2 * n * search + 5 * 4 * n + 2 * p * pair + 2 * 8 * p + 4 * 4 * hw,
            "weights": p * (8 + 8 + 8 + 8)
            + 4 * n
            + 4 * hw
            + (p * 8 + 6 * 4 * n if self.tau > 0 else 0),
            "blend": 8 * blended + ROW * kept + (ROW + 4) * hw,
            "backward": p * (4 + 8) + ROW * kept + (ROW + 8) * n + 2 * (ROW + 4) * hw,
        }


class GridScene(_Scene):
    """About n discs of the paper's radius on a grid inside the unit ball, seen from a distance of 4
    under 40 degrees.

    Opacities are uniform in [0.7, 1]: in a trained model few are lower. The camera looks along no
    axis of the grid.
    """

    name, forward = "grid", ("project", "pairs", "weights", "shade", "blend")

    def __init__(self, dev, n, size, gamma):
        rng = np.random.default_rng(0)
        edge = (4 / 3 * np.pi / n) ** (1 / 3)
        side = int(2 / edge) + 2
        grid = Grid((-edge * (side - 1) / 2,) * 3, edge, (side,) * 3)
        squares = (grid.origin[0] + edge * np.arange(side)) ** 2
        ids = np.flatnonzero(squares[:, None, None] + squares[:, None] + squares < 1).astype(
            np.uint32
        )
        self.size, self.gamma, self.count = size, gamma, len(ids)
        axes, _ = np.linalg.qr([[0.9, 0.2, -0.4], [-0.3, 0.8, 0.5], [0.2, -0.5, 0.8]])
        axes[:, 2] *= np.linalg.det(axes)
        focal = size / (2 * np.tan(np.radians(20)))
        pose = np.concatenate([axes, -4 * axes[:, 2:]], 1)
        self.camera = Camera(pose, focal, focal, size / 2, size / 2, size, size, 2.0, 6.0)

        model = Model.create(dev, grid, ids, (2.0, 6.0), (CHANNELS,) * 3, seed=0)
        self.opacity = rng.uniform(0.7, 1, self.count).astype(np.float32)
        self.sh0 = rng.standard_normal((self.count, 1, CHANNELS), np.float32)
        model.points["opacity"].set(self.opacity)
        model.points["sh0"].set(self.sh0)
        for name, coefficients in model.points.items():
            if name.startswith("sh") and name != "sh0":
                dev.fill(coefficients, HIGHER_SH)
        self.settings = RasterConfig(footprint="disc", radius=0.0015)
        self.renderer = Renderer(dev, model, self.settings)
        self.pairs, self.weights = self.renderer.pairs, self.renderer.weights
        self.grad = dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32))
        self.reference = PixelReference(
            self.camera, grid.positions(ids), self.settings.radius, "disc"
        )

    @property
    def tau(self):
        """Of the stages run next."""
        return self.settings.tau

    @tau.setter
    def tau(self, value):
        self.settings.tau = value

    @property
    def blended(self):
        """(H, W, 16) device array of the stages run last."""
        return self.renderer.features

    @property
    def point_rows(self):
        """(N, 16) device array of the points' features, the kept ones of the stages run last."""
        return self.renderer.point_features

    def stages(self):
        """{name: function} in their order."""
        return self.renderer.stages(self.camera, self.gamma) | {
            "backward": lambda: self.renderer.backward_features(self.grad)
        }

    def shaded(self, points):
        """(S, 16) float64 features of some points."""
        x, y, z = (
            self.reference.points[points]
            / self.reference.range[points, None]
            @ self.camera.pose[:, :3].T
        ).T
        # the sum of the harmonics 1 to 8 of cl/sh.h
        higher = (
            0.4886025119029199 * (z - y - x)
            + 1.0925484305920792 * (x * y - y * z - x * z)
            + 0.9461746957575601 * z**2
            - 0.31539156525252005
            + 0.5462742152960396 * (x**2 - y**2)
        )
        return (
            0.28209479177387814 * self.sh0[points, 0].astype(np.float64)
            + HIGHER_SH * higher[:, None]
        )

    def moved(self):
        """As _Scene, with the stages of a grid and of harmonics."""
        shading = 4 + 16 + 9 * ROW + ROW
        return {
            "project": self.count * (4 + 16 + 8),
            "shade": self.weights.kept.size * shading,
        } | super().moved()


class PulsarScene(_Scene):
    """Spheres of radius 0.0015, uniform in a cube of side 1 at a depth of 1 to 2: Pulsar's own
    benchmark.

    Focal length and sensor are equal, near is 0.6, far 2.5, opacities are 1. Stage `spheres`:
    gradients of places and radii.
    """

    name, forward = "pulsar", ("project", "pairs", "weights", "blend")
    radius, near, far = 0.0015, 0.6, 2.5

    def __init__(self, dev, n, size, gamma):
        rng = np.random.default_rng(0)
        self.size, self.gamma, self.count, self.tau = size, gamma, n, 0.0
        self.camera = Camera(
            np.eye(3, 4), size, size, size / 2, size / 2, size, size, self.near, self.far
        )
        self.opacity = np.ones(n, np.float32)
        positions = rng.random((n, 3), np.float32) + np.float32([-0.5, -0.5, 1])
        self.point_features = rng.random((n, CHANNELS), np.float32)
        self.reference = PixelReference(self.camera, positions, self.radius, "sphere")

        footprint = Footprint("sphere")
        self.projection, self.pairs = Projection(dev, footprint), Pairs(dev, footprint)
        self.weights, self.blend = Weights(dev), Blend(dev, footprint)
        self.arrays = {
            "view": dev.upload(self.camera.packed()),
            "radius": dev.upload([self.radius], np.float32),
            "positions": dev.upload(positions),
            "opacity": dev.upload(self.opacity),
            "features": dev.upload(self.point_features),
            "grad": dev.upload(rng.standard_normal((size, size, CHANNELS), np.float32)),
        }
        self.point_rows = self.arrays["features"]
        self.blended = dev.empty((size, size, CHANNELS))
        self.grads = [dev.empty(shape) for shape in ((n, CHANNELS), (n,), (n, 3), (n,))]

    def stages(self):
        """{name: function} in their order."""
        a, pairs, weights, blend, projection = (
            self.arrays,
            self.pairs,
            self.weights,
            self.blend,
            self.projection,
        )
        of_features, of_opacity, of_positions, of_radius = self.grads
        return {
            "project": lambda: projection.spheres(a["view"], a["positions"], a["radius"]),
            "pairs": lambda: pairs.build(
                a["view"], (self.size, self.size), projection, a["radius"]
            ),
            "weights": lambda: weights.weigh(
                pairs, a["view"], a["opacity"], self.gamma, tau=self.tau
            ),
            "blend": lambda: blend.forward(pairs, a["features"], self.blended),
            "backward": lambda: blend.backward(
                pairs,
                weights.pair_weight,
                a["features"],
                self.blended,
                a["grad"],
                of_features,
                of_opacity,
            ),
            "spheres": lambda: blend.backward_spheres(
                pairs,
                weights.pair_weight,
                a["view"],
                self.gamma,
                a["radius"],
                projection.point_camera,
                a["opacity"],
                a["features"],
                self.blended,
                a["grad"],
                of_positions,
                of_radius,
            ),
        }

    def shaded(self, points):
        """(S, 16) float64 features of some points."""
        return self.point_features[points].astype(np.float64)

    def moved(self):
        """As _Scene, with the stages of spheres."""
        n, p, hw = self.count, self.pairs.total, self.size**2
        spheres = p * (4 + 8 + 8 + 8) + p * (4 + 8) + (ROW + 16 + 16) * n + 2 * (ROW + 4) * hw
        return {"project": n * (12 + 16 + 8), "spheres": spheres} | super().moved()


SCENES = {scene.name: scene for scene in (GridScene, PulsarScene)}
