"""The renderer: from a model and a camera to an image, and back to gradients. This is the
one place that writes the order of the stages.

project -> pairs -> blend weights -> shade the visible points -> blend their features -> U-Net
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pyopencl.array import Array

from pp_cl.device.buffers import Buffers, Reading, Table
from pp_cl.device.device import Device
from pp_cl.files.picture import Picture
from pp_cl.layers.tiles import tiles_hit
from pp_cl.model import Model
from pp_cl.raster.blend import blend_backward, blend_backward_table, blend_forward, shade_forward
from pp_cl.raster.depth import depth_forward
from pp_cl.raster.pairs import Pairs, find_pairs, pairs_table, room_needed
from pp_cl.raster.project import ProjectedPoints, project_grid, projection_table
from pp_cl.raster.weights import BlendWeights, blend_weights, weights_table
from pp_cl.scene.camera import Camera
from pp_cl.settings import RasterConfig

NETWORK_MULTIPLE = 4  # the U-Net halves its input twice
# far - near of the scenes for which the paper's radius of 0.0015 was chosen
PAPER_DEPTH_RANGE = 4.0


def point_radius(settings: RasterConfig, edge: float, depth_range: tuple[float, float]) -> float:
    """The points' radius in world units. edge: of the grid, world units."""
    if settings.footprint == "soft":
        return settings.radius * edge
    near, far = depth_range
    return settings.radius * (far - near) / PAPER_DEPTH_RANGE


@dataclass
class RenderResult:
    """What the stages of a view have made, up to the one that was asked for; arrays are valid until
    the next view.

    camera: of the view. size: (H, W) of the image that is rendered, padded to multiples of 4.
    offset: (left, top) of the view in it. points: the N points as the padded camera sees them.
    tiles: (rows, columns) bool, the 4x4 tiles of the padded image that have hits. point_features:
    (N, 16) float32, of which only the rows weights.shaded are set. features: (H, W, 16) float32,
    blended from them. image: (H, W, 3) float32, unclamped. computed_fraction: share of the
    network's multiplications that was done; the others would have seen only background.
    """

    camera: Camera
    offset: tuple[int, int]
    size: tuple[int, int]
    points: ProjectedPoints
    pairs: Pairs
    weights: BlendWeights
    tiles: Reading[np.ndarray]
    point_features: Array | None = None
    features: Array | None = None
    image: Array | None = None
    computed_fraction: float = 1.0

    def clamped(self) -> np.ndarray:
        """(height, width, 3) float32 image without the padding, clamped to [0, 1]."""
        return np.clip(self.cropped(self.image.get()), 0, 1)

    def cropped(self, array: np.ndarray) -> np.ndarray:
        """(height, width, ...): an array of the padded pixels without the padding."""
        left, top = self.offset
        return array[top : top + self.camera.height, left : left + self.camera.width]


class Renderer:
    """Renders a model. Its buffers are reused from view to view."""

    def __init__(self, dev: Device, model: Model, settings: RasterConfig):
        self.dev = dev
        self.model = model
        self.settings = settings
        self._buffers = Buffers(dev)
        self._room = 1  # capacity of the arrays of pairs; grows with the views
        self._radius = None  # what b.point_radius holds

    @staticmethod
    def tables(
        settings: RasterConfig, n: int, size: tuple[int, int], pairs: int
    ) -> dict[str, Table]:
        """The renderer's buffers, grouped by their line in the memory plan, for n points, a padded
        image of size (height, width) and an estimated number of pairs; the true number is known
        once a view has been projected.
        """
        pixels, has_roles = size[0] * size[1], settings.early_stop > 0 or settings.max_tracked > 0
        return {
            "projection": projection_table(n),
            "pairs (estimate)": pairs_table(n, pixels, pairs),
            "blend weights (estimate)": weights_table(n, pixels, pairs, has_roles),
            "features": _view_table(n, size),
            "gradients (estimate)": blend_backward_table(n, pixels, pairs, settings.blend),
        }

    def forward(
        self,
        camera: Camera,
        gamma: float,
        *,
        until: Literal["weights", "features", "image"] = "image",
        dropout: float = 0.0,
        seed: int = 0,
        early_stop: float | None = None,
        depth_range: tuple[float, float] | None = None,
        training: bool = False,
        gradient_tiles: Callable[[], np.ndarray | None] = lambda: None,
    ) -> RenderResult:
        """Render a camera, which is padded to multiples of 4 pixels.

        until: the last stage wanted: blend weights, blended features or the network's image.
        gamma: depth sharpness of the softmax, unused by alpha compositing. dropout: share of the
        points left out, at random by `seed`. early_stop: instead of the settings'. depth_range:
        instead of the model's, for cameras that see beyond it; the softmax needs the model's.
        training: keep what backward() needs. gradient_tiles: returns that argument of
        UNet.plan_tiles(); called after the wait for the device.
        """
        dev, b, cloud, net = self.dev, self._buffers, self.model.cloud, self.model.net
        padded, *offset = camera.padded(NETWORK_MULTIPLE)
        size = (padded.height, padded.width)
        b.require(_view_table(cloud.count, size))
        dev.send(b.camera_buffer, self.model.packed(padded, depth_range))
        self._set_radius()
        with dev.stage("project"):
            points = project_grid(
                dev,
                b,
                self.settings.footprint,
                b.camera_buffer,
                self.model.grid_buffer,
                point_id=cloud.ids,
                point_radius=b.point_radius,
                dropout=dropout,
                seed=seed,
            )
        pairs, weights, tiles = self._pairs_and_weights(points, size, gamma, early_stop)
        result = RenderResult(camera, tuple(offset), size, points, pairs, weights, tiles)
        if until == "weights":
            return result
        with dev.stage("shade"):
            shade_forward(dev, points, weights.shaded, cloud.sh, point_features=b.point_features)
        with dev.stage("blend"):
            blend_forward(dev, pairs, weights, b.point_features, b.features)
        result.point_features, result.features = b.point_features, b.features
        if until == "features":
            return result
        with dev.stage("network"):
            plan = None
            if net.is_planned(size):
                plan = net.plan_tiles(size, tiles.get(), gradient_tiles())
                result.computed_fraction = plan.computed_fraction
            result.image = net.forward(b.features, training, plan)
        return result

    def _pairs_and_weights(self, points, size, gamma, early_stop):
        """(Pairs, BlendWeights, tiles that have hits). Both stages are enqueued before the number
        of pairs is known, and run again with more room if it was too small.
        """
        settings = self.settings
        while True:
            with self.dev.stage("pairs"):
                pairs = find_pairs(self.dev, self._buffers, points, size, self._room)
            with self.dev.stage("weights"):
                weights = blend_weights(
                    self.dev,
                    self._buffers,
                    pairs,
                    points.camera_buffer,
                    self.model.cloud.opacity,
                    blend=settings.blend,
                    gamma=gamma,
                    max_tracked=settings.max_tracked,
                    early_stop=settings.early_stop if early_stop is None else early_stop,
                )
            tiles = tiles_hit(self.dev, pairs.pixel_offset, size)
            tiles.get()  # the host's one wait for the device
            self._room = room_needed(pairs)
            if self._room == pairs.capacity:
                return pairs, weights, tiles
            del pairs, weights  # else their arrays would stay beside the larger ones

    def _set_radius(self):
        """Send the points' radius to b.point_radius if it changed: refining halves the spacing."""
        model = self.model
        radius = point_radius(self.settings, model.grid.edge, model.depth_range)
        if radius != self._radius:
            self.dev.send(self._buffers.point_radius, np.array([radius], np.float32))
            self._radius = radius

    def backward(
        self,
        result: RenderResult,
        grad_image: Array,
        grad_alpha: Array | None = None,
        spread_weight: float = 0.0,
    ) -> tuple[Array, Array]:
        """(grad_point_features (N, 16), grad_opacity (N,)) from dL/dimage of result.image; with
        alpha compositing also from dL/dalpha (H * W,), and of the spread of each pixel's hits with
        this weight in the loss (cl/raster/blend.cl).

        result: of the last forward(training=True). The gradients of the network's parameters are
        left in model.net.gradients. Those of the SH coefficients are grad_point_features times the
        basis functions in the view's direction; the optimiser multiplies them as it moves each
        coefficient, and never stores them.
        """
        with self.dev.stage("network backward"):
            grad_features = self.model.net.backward(grad_image)
        return self.backward_features(result, grad_features, grad_alpha, spread_weight)

    def backward_features(
        self,
        result: RenderResult,
        grad_features: Array,
        grad_alpha: Array | None = None,
        spread_weight: float = 0.0,
    ) -> tuple[Array, Array]:
        """What backward() does, from dL/dfeatures (H, W, 16) of result.features, without the
        network.
        """
        with self.dev.stage("backward"):
            return blend_backward(
                self.dev,
                self._buffers,
                result.pairs,
                result.weights,
                point_features=result.point_features,
                features=result.features,
                grad_features=grad_features,
                grad_alpha=grad_alpha,
                spread_weight=spread_weight,
                mean=self.settings.mean_gradient,
            )

    def render(self, camera: Camera, gamma: float, **options) -> np.ndarray:
        """(H, W, 3) float32 numpy image of the camera, clamped to [0, 1]. options: of forward()."""
        return self.forward(camera, gamma, **options).clamped()

    def picture(
        self, camera: Camera, gamma: float, *, features: bool = False, **options
    ) -> Picture:
        """Colour, alpha and depth of the camera; with its features where asked for. options: of
        forward().
        """
        result = self.forward(camera, gamma, **options)
        with self.dev.stage("depth"):
            arrays = depth_forward(
                self.dev, result.points, result.pairs, result.weights, result.size
            )
        alpha, depth, median = (result.cropped(array.get()) for array in arrays)
        shown = result.cropped(result.features.get()) if features else None
        return Picture(result.clamped(), alpha, depth, median, features=shown)


def _view_table(n, size):
    """Buffers that each view overwrites and that belong to no single stage."""
    return {
        "camera_buffer": ((20,), np.float32),
        "point_radius": ((1,), np.float32),
        "point_features": ((n, 16), np.float32),
        "features": ((*size, 16), np.float32),
    }
