"""From a model and a camera to an image, and back to gradients: the one place that writes the order
of the stages.

project -> pairs -> blend weights -> shade the points that contribute -> blend features -> U-Net
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Table
from pp_cl.device.device import Device
from pp_cl.files.picture import Picture
from pp_cl.layers.tiles import TileFlags, tiles_hit
from pp_cl.model import Model
from pp_cl.raster.blend import BLENDS, Blend
from pp_cl.raster.blend_weights import PixelWeights
from pp_cl.raster.depth import depth_forward
from pp_cl.raster.pairs import PairBuilder, Pairs
from pp_cl.raster.project import Footprint, ProjectedPoints, Projection
from pp_cl.raster.shade import shade_forward
from pp_cl.scene.camera import Camera
from pp_cl.settings import RasterConfig

NETWORK_MULTIPLE = 4  # the U-Net halves its input twice
PAPER_DEPTH_RANGE = (
    4.0  # far - near of the scenes for which the paper's radius of 0.0015 was chosen
)


def point_radius(settings: RasterConfig, edge: float, depth_range: tuple[float, float]) -> float:
    """The points' radius in world units. edge: of the grid, world units."""
    if settings.footprint == "soft":
        return settings.radius * edge
    near, far = depth_range
    return settings.radius * (far - near) / PAPER_DEPTH_RANGE


@dataclass(frozen=True)
class ViewWeights:
    """Which points contribute to a view, and how much; valid until the next view is weighed.

    offset: (left, top) of the view in its padded image of H x W pixels. points: the N points in the
    padded camera. tiles: those of the padded image that have hits, None where nobody asks.
    """

    offset: tuple[int, int]
    points: ProjectedPoints
    pairs: Pairs
    weights: PixelWeights
    tiles: TileFlags | None

    @property
    def camera_buffer(self) -> Array:
        """(20,) float32, the padded camera, cl/camera.h."""
        return self.points.camera_buffer

    @property
    def shaded(self) -> Array:
        """(S,) uint32, ascending: the points that contribute."""
        return self.weights.shaded


@dataclass(frozen=True)
class RasterResult(ViewWeights):
    """ViewWeights with the points' features (N, 16), of which the rows `shaded` are set, and the
    features blended of them, (H, W, 16); float32.
    """

    point_features: Array
    features: Array


@dataclass(frozen=True)
class RenderResult(RasterResult):
    """A RasterResult with the image that the network made of it, (H, W, 3) float32, unclamped.

    computed_fraction: of the network's multiplications; the rest saw only background.
    """

    image: Array
    computed_fraction: float

    def clamped(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) float32 image of the camera without the padding, clamped to [0, 1]."""
        return np.clip(self.cropped(self.image.get(), camera), 0, 1)

    def cropped(self, array: np.ndarray, camera: Camera) -> np.ndarray:
        """(height, width, ...) of the camera: an array of the padded pixels without the padding."""
        left, top = self.offset
        return array[top : top + camera.height, left : left + camera.width]


class Renderer:
    """Renders a model. Its buffers are reused from view to view."""

    def __init__(self, dev: Device, model: Model, settings: RasterConfig):
        self.dev = dev
        self.model = model
        self.settings = settings
        self._footprint = footprint = Footprint(settings.footprint)
        self._projection = Projection(dev, footprint)
        self._pairs = PairBuilder(dev, footprint)
        self._weights = BLENDS[settings.blend](dev)
        self._blend = Blend(dev, self._weights, settings.mean_gradient)
        self._buffers = Buffers(dev)

    @staticmethod
    def table(n: int, height: int, width: int) -> Table:
        """The renderer's own buffers for n points and a padded image."""
        return {
            "camera_buffer": ((20,), np.float32),
            "point_radius": ((1,), np.float32),
            "point_features": ((n, 16), np.float32),
            "features": ((height, width, 16), np.float32),
        }

    def forward(
        self,
        camera: Camera,
        gamma: float,
        *,
        training: bool = False,
        differs: Callable[[], np.ndarray | None] = lambda: None,
        **options,
    ) -> RenderResult:
        """Render a camera. training: keep what backward() needs. differs: of UNet.plan_tiles(),
        asked once the device was waited for. options: of rasterise().
        """
        raster, net = self.rasterise(camera, gamma, **options), self.model.net
        with self.dev.stage("network"):
            size, plan = raster.features.shape[:2], None
            if net.is_planned(size):
                plan = net.plan_tiles(size, raster.tiles.get(), differs())
            image = net.forward(raster.features, training, plan)
        fraction = plan.computed_fraction if plan else 1.0
        return RenderResult(**vars(raster), image=image, computed_fraction=fraction)

    def rasterise(self, camera: Camera, gamma: float, **options) -> RasterResult:
        """The blended features of a camera. options: of blend_weights()."""
        view, cloud, b = (
            self.blend_weights(camera, gamma, **options),
            self.model.cloud,
            self._buffers,
        )
        with self.dev.stage("shade"):
            shade_forward(
                self.dev, view.points, view.shaded, cloud.sh, point_features=b.point_features
            )
        with self.dev.stage("blend"):
            self._blend.forward(view.pairs, view.weights, b.point_features, b.features)
        return RasterResult(**vars(view), point_features=b.point_features, features=b.features)

    def blend_weights(
        self,
        camera: Camera,
        gamma: float,
        *,
        dropout: float = 0.0,
        seed: int = 0,
        early_stop: float | None = None,
        depth_range: tuple[float, float] | None = None,
    ) -> ViewWeights:
        """The blend weights of a camera, which is padded to multiples of 4 pixels.

        dropout: share of the points left out, at random by `seed`. early_stop: instead of the
        settings'. depth_range: instead of the model's, which a
        camera may see beyond that is none of the scene's; a softmax of depth needs the model's.
        """
        cloud, settings, b = self.model.cloud, self.settings, self._buffers
        padded, *offset = camera.padded(NETWORK_MULTIPLE)
        size = (padded.height, padded.width)
        b.require(self.table(cloud.count, *size))
        self.dev.send(b.camera_buffer, self.model.packed(padded, depth_range))
        self.dev.send(b.point_radius, np.array([self._radius()], np.float32))
        with self.dev.stage("project"):
            points = self._projection.grid(
                b.camera_buffer,
                self.model.grid_buffer,
                cloud.ids,
                b.point_radius,
                dropout=dropout,
                seed=seed,
            )
        drops = {
            "max_tracked": settings.max_tracked,
            "early_stop": settings.early_stop if early_stop is None else early_stop,
        }
        pairs, weights, tiles = self._weigh(points, size, gamma, drops)
        return ViewWeights(tuple(offset), points, pairs, weights, tiles)

    def _weigh(self, points, size, gamma, drops):
        """(Pairs, PixelWeights, TileFlags): anew where there was no room for all pairs."""
        while True:
            with self.dev.stage("pairs"):
                pairs = self._pairs.enqueue(points, size)
            with self.dev.stage("weights"):
                weights = self._weights.compute(
                    pairs, points.camera_buffer, self.model.cloud.opacity, gamma, **drops
                )
            tiles = tiles_hit(self.dev, pairs.pixel_offset, size)
            tiles.get()  # the host's one wait for the device
            if self._pairs.has_room(pairs):
                return pairs, weights, tiles
            del pairs, weights  # else their arrays would stay beside the larger ones

    def backward(
        self,
        result: RenderResult,
        grad_image: Array,
        grad_alpha: Array | None = None,
        *,
        spread_weight: float = 0.0,
    ) -> tuple[Array, Array]:
        """(grad_point_features (N, 16), grad_opacity (N,)) from dL/dimage of result.image, and
        dL/dalpha (H * W,) of its pixels' alpha and a weight of their spread where the blend has
        a transmittance (BlendWeights.rest_or_gain).

        result: the last one of forward(training=True). The gradients of the network's parameters
        are in model.net.gradients; those of the SH coefficients are rank one in
        grad_point_features, and the optimiser never forms them.
        """
        with self.dev.stage("network backward"):
            grad_features = self.model.net.backward(grad_image)
        return self.backward_features(
            result, grad_features, grad_alpha, spread_weight=spread_weight
        )

    def backward_features(
        self,
        result: RasterResult,
        grad_features: Array,
        grad_alpha: Array | None = None,
        *,
        spread_weight: float = 0.0,
    ) -> tuple[Array, Array]:
        """The same from dL/dfeatures (H, W, 16) of result.features."""
        with self.dev.stage("backward"):
            gradient = self._blend.gradient(
                result.pairs,
                result.weights,
                result.point_features,
                features=result.features,
                grad_features=grad_features,
                grad_alpha=grad_alpha,
                spread_weight=spread_weight,
            )
            return self._blend.backward(gradient)

    def raise_peaks(self, view: ViewWeights, peaks: Array, looks: Array) -> None:
        """Raise peaks to each point's blend weights, summed over the view's pixels, where they are
        higher, and add 1 to looks where the point is in the view, hidden or not; both (N,) float32.
        """
        self._weights.raise_peaks(view.pairs, view.weights, peaks, looks)

    def render(self, camera: Camera, gamma: float, **options) -> np.ndarray:
        """(H, W, 3) float32 numpy image of the camera, clamped to [0, 1]. options: of
        blend_weights().
        """
        return self.forward(camera, gamma, **options).clamped(camera)

    def picture(
        self, camera: Camera, gamma: float, *, features: bool = False, **options
    ) -> Picture:
        """Colour, alpha and depth of the camera; with its features where asked for. options: of
        blend_weights().
        """
        result = self.forward(camera, gamma, **options)
        size = result.features.shape[:2]
        with self.dev.stage("depth"):
            view = result.points, result.pairs, result.weights
            arrays = depth_forward(self.dev, *view, footprint=self._footprint, size=size)
        alpha, *depths = (array.get() for array in arrays)
        return Picture(
            result.clamped(camera),
            result.cropped(alpha, camera),
            *(result.cropped(depth, camera) for depth in depths),
            features=result.cropped(result.features.get(), camera) if features else None,
        )

    def _radius(self):
        return point_radius(self.settings, self.model.grid.edge, self.model.depth_range)
