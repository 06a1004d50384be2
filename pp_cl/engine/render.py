"""The renderer: renders a model for a camera and computes gradients from the image's. Only this
module sets the order of the stages.

project -> pairs of points and tiles -> blend weights -> shade the visible points -> blend -> U-Net
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.buffers import Buffers, Pending, Table, grown
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.conv import GradientParts
from pp_cl.engine.layers.simple import specular_forward
from pp_cl.engine.model import Model
from pp_cl.engine.raster.blend import (
    BlendGradients,
    blend_backward,
    blend_backward_table,
    blend_forward,
    shade_forward,
)
from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.engine.raster.fragments import count_fragments
from pp_cl.engine.raster.highest_weights import record_weights, recording_table
from pp_cl.engine.raster.pairs import Pairs, capacity_needed, find_pairs, pairs_table
from pp_cl.engine.raster.project import (
    ProjectedPoints,
    project_grid,
    projection_table,
    tiles_of,
)
from pp_cl.engine.raster.weights import BlendWeights, blend_weights, weights_table
from pp_cl.errors import UserError
from pp_cl.settings import RasterConfig

MOST_SIDE = 2**16 - 1  # pixels along a side of an image: points' boxes have 16 bits
# far - near of the scenes for which the paper's radius of 0.0015 was chosen
PAPER_DEPTH_RANGE = 4.0


def point_radius(
    settings: RasterConfig, voxel_size: float, depth_range: tuple[float, float]
) -> float:
    """The radius in world units of points whose offset is 0. voxel_size: world units."""
    if FOOTPRINTS[settings.footprint].moves:
        return settings.radius * voxel_size
    near, far = depth_range
    return settings.radius * (far - near) / PAPER_DEPTH_RANGE


def is_supersampled(settings: RasterConfig) -> bool:
    """Whether a pixel can have several samples: only with discs composited by alpha."""
    return settings.blend == "alpha" and FOOTPRINTS[settings.footprint].is_disc


def view_table(
    dev: Device,
    settings: RasterConfig,
    n: int,
    size: tuple[int, int],
    pairs: int,
    visible: int,
    *,
    until: Literal["weights", "image"] = "image",
    training: bool = False,
    supersampling: int = 1,
) -> Table:
    """The buffers of Renderer for a view of n points in an image of size (height, width), with
    these numbers of pairs and of visible points. until, training: as in forward(); "weights"
    includes the buffers of record_weights(), training those of backward(). supersampling: as in
    RenderResult.
    """
    records = until == "weights"
    (rows, columns), kind = tiles_of(size, supersampling), (settings.blend, settings.footprint)
    table = projection_table(n, settings.footprint)
    table |= pairs_table(dev, n, size, pairs, supersampling, by_point=training or records)
    table |= weights_table(n, size, settings.blend, supersampling, derivatives=training)
    table["features"] = (*size, 16), np.float32
    if records:
        return table | recording_table(pairs)
    table["visible_features"] = (visible, 16), np.float32
    if training:
        table |= blend_backward_table(visible, pairs, rows * columns, *kind)
    return table


@dataclass
class RenderResult:
    """The results of a view's stages, up to the last one requested; arrays are valid until the next
    view.

    camera: the view's. size: (H, W) of the rendered image, padded to multiples of 4. offset: (left,
    top) of the view in the padded image. points: the N points as the camera sees them. tile_mask:
    (rows, columns) bool, the 4x4 tiles of pixels that show points; None if the network computes
    all tiles. supersampling: samples of a pixel along each axis. visible_features: float32, one row
    of 16 for each point of weights.visible, then unused rows. features: (H, W, 16) float32, blended
    from them. image: (H, W, 3) float32, unclamped. computed_fraction: share of the network's
    multiplications that were computed; the others would have processed only background.
    """

    dev: Device
    camera: Camera
    offset: tuple[int, int]
    size: tuple[int, int]
    points: ProjectedPoints
    pairs: Pairs
    weights: BlendWeights
    tile_mask: Pending[np.ndarray] | None
    supersampling: int = 1
    visible_features: Array = field(init=False)
    features: Array = field(init=False)
    image: Array = field(init=False)
    computed_fraction: float = 1.0

    @property
    def transmittance(self) -> Array | None:
        """(H * W,) float32: weights.transmittance; None with the softmax."""
        return self.weights.transmittance if self.weights.blend == "alpha" else None

    def specular_arguments(self, extent: float) -> dict[str, Any]:
        """The arguments, by name, with which a kernel computes the inputs of the specular layer:
        features, direction and place of each pixel. extent: world units of 1 in places.
        """
        return {
            "width": self.size[1],
            "supersampling": float(self.supersampling),
            "extent": extent,
            "camera": self.points.camera_buffer,
            "transmittance": self.transmittance,
            "features": self.features,
            "mean_range": self.weights.mean_range,
        }

    def fragments(self) -> tuple[np.ndarray, np.ndarray]:
        """Two (height, width) int64: the number of fragments of each pixel, and of those that are
        not dropped, without the padding.
        """
        counts = count_fragments(self.dev, self.points, self.pairs, self.weights)
        found, shown = map(self.cropped, counts)
        return found, shown

    def clamped(self) -> np.ndarray:
        """(height, width, 3) float32 image without the padding, clamped to [0, 1]."""
        return np.clip(self.cropped(self.dev.download(self.image)), 0, 1)

    def cropped(self, array: np.ndarray) -> np.ndarray:
        """(height, width, ...): an array of the padded pixels without the padding."""
        left, top = self.offset
        return array[top : top + self.camera.height, left : left + self.camera.width]


@dataclass
class Capacity:
    """The numbers of pairs and of visible points that a view's arrays hold; both grow with the
    views.
    """

    pairs: int = 1
    visible: int = 1


class Renderer:
    """Renders a model. Its buffers are reused from view to view. supersampling: of images, as in
    RenderResult, 1 or 2. margin: pixels that are rendered around an image and cut off, except in a
    training: the network pads its input with zeros, which darkens pixels at the border.
    """

    def __init__(
        self,
        dev: Device,
        model: Model,
        settings: RasterConfig,
        supersampling: int = 1,
        margin: int = 0,
    ):
        self.dev = dev
        self.model = model
        self.settings = settings
        # Images and a training's steps take turns in memory, as previews are larger than crops;
        # each of the two has its capacity.
        self._by_pair = False
        self._capacities = {False: Capacity(), True: Capacity()}
        self.supersampling, self.margin = supersampling, margin
        self.release()

    @property
    def point_radius(self) -> float:
        """The radius in world units of points whose offset is 0."""
        return point_radius(self.settings, self.model.grid.voxel_size, self.model.depth_range)

    def release(self) -> None:
        """Free the buffers; the next view makes them anew."""
        self.model.net.release()
        self._buffers = Buffers(self.dev)

    def forward(
        self,
        camera: Camera,
        gamma: float,
        *,
        until: Literal["weights", "features", "image"] = "image",
        early_stop: float | None = None,
        depth_range: tuple[float, float] | None = None,
        supersampling: int | None = None,
        training: bool = False,
        gradient_tiles: Pending[np.ndarray] | None = None,
        times_seen: Array | None = None,
    ) -> RenderResult:
        """Render a camera's image, padded by the margin and to multiples of net.multiple pixels.

        until: the last stage to run: blend weights, blended features or the network's image. Only
        the image is supersampled, if it is composited by alpha.
        gamma: depth sharpness of the softmax, unused by alpha compositing. early_stop: replaces the
        settings'. depth_range: replaces the model's, for cameras that see beyond it; the softmax
        needs the model's. supersampling: replaces the renderer's.
        training: keep the arrays that backward() needs. gradient_tiles: what
        Network.gradient_tiles() returned; its value is taken after the wait for the device.
        times_seen: as for find_pairs().
        """
        dev, cloud, net = self.dev, self.model.cloud, self.model.net
        margin = self.margin if until == "image" and not training else 0
        padded, left, top = camera.padded(net.multiple, margin)
        size = padded.height, padded.width
        is_finer = until == "image" and is_supersampled(self.settings)
        supersampling = (supersampling or self.supersampling) if is_finer else 1
        if max(size) > MOST_SIDE:
            raise UserError(
                f"an image of {camera.width}x{camera.height} pixels: at most {MOST_SIDE} each way"
                " are rendered; render parts of it"
            )
        by_pair = training or until == "weights"
        if by_pair != self._by_pair:
            self._by_pair = by_pair
            self.release()
        b = self._buffers
        b.require({"camera_buffer": ((21,), np.float32), "features": ((*size, 16), np.float32)})
        of_samples = padded.enlarged(supersampling) if supersampling > 1 else padded
        dev.send(b.camera_buffer, self.model.packed(of_samples, depth_range))
        with dev.stage("project"):
            points = project_grid(
                dev,
                b,
                self.settings.footprint,
                b.camera_buffer,
                self.model.grid_buffer,
                point_id=cloud.ids,
                cloud_offset=cloud.offset,
                opacity=cloud.opacity,
                radius=self.point_radius,
                supersampling=supersampling,
            )
        is_planned = net.is_planned(size)
        options = gamma, early_stop, training, by_pair, times_seen
        pairs, weights, tile_mask = self._pairs_and_weights(points, size, is_planned, *options)
        view = camera, (left, top), size
        result = RenderResult(dev, *view, points, pairs, weights, tile_mask, supersampling)
        if until == "weights":
            return result
        with dev.stage("shade"):
            visible, count = weights.visible_rows, weights.total
            capacity = self._capacities[by_pair]
            capacity.visible = grown(capacity.visible, count)
            rows = min(capacity.visible, cloud.count)
            b.require({"visible_features": ((rows, 16), np.float32)})
            shade_forward(
                dev, points, visible, count, cloud.sh, visible_features=b.visible_features
            )
        with dev.stage("blend"):
            blend_forward(dev, b, points, pairs, weights, b.visible_features, b.features)
        result.visible_features, result.features = b.visible_features, b.features
        if until == "features":
            return result
        with dev.stage("network"):
            plan: Any = None
            if is_planned:
                reached = gradient_tiles.get() if gradient_tiles else None
                plan = net.plan_tiles(size, tile_mask.get(), reached)
                result.computed_fraction = plan.computed_fraction if plan else 1.0
            result.image = net.forward(result.features, training, plan)
            if specular := self.model.specular:
                of_view = result.specular_arguments(self.model.extent)
                specular_forward(dev, specular.parameters, result.image, of_view)
        return result

    def _pairs_and_weights(
        self, points, size, is_planned, gamma, early_stop, training, by_point, times_seen
    ):
        """(Pairs, BlendWeights, RenderResult.tile_mask or None unless is_planned). Both stages are
        enqueued before the number of pairs is known, and run again with more capacity if it was too
        small.
        """
        settings, capacity, b = self.settings, self._capacities[self._by_pair], self._buffers
        while True:
            with self.dev.stage("pairs"):
                pairs = find_pairs(self.dev, b, points, size, capacity.pairs, times_seen, by_point)
                pairs.read_count(self.dev)
            with self.dev.stage("weights"):
                weights = blend_weights(
                    self.dev,
                    b,
                    points,
                    pairs,
                    blend=settings.blend,
                    gamma=gamma if settings.blend == "softmax" else 1.0,
                    max_tracked=settings.max_tracked,
                    early_stop=settings.early_stop if early_stop is None else early_stop,
                    derivatives=training,
                )
                weights.read_count(self.dev)
            tile_mask = weights.read_covered(self.dev) if is_planned else None
            (tile_mask or weights.count).get()  # the host's only wait for the device
            capacity.pairs = capacity_needed(pairs)
            if capacity.pairs == pairs.capacity:
                return pairs, weights, tile_mask
            del pairs, weights  # frees their arrays before larger ones are allocated

    def backward(
        self, result: RenderResult, grad_image: Array, **options: Any
    ) -> tuple[BlendGradients, GradientParts | None]:
        """(gradients from backward_features(), parameter gradients from Network.backward()),
        computed from dL/dimage of result.image. options: for backward_features().
        """
        with self.dev.stage("network backward"):
            grad_features, parts = self.model.net.backward(grad_image)
        return self.backward_features(result, grad_features, **options), parts

    def backward_features(
        self,
        result: RenderResult,
        grad_features: Array,
        *,
        grad_alpha: Array | None = None,
        distortion_weight: float = 0.0,
        depth_gradient: Array | None = None,
        with_offsets: bool = False,
        max_weight: Array | None = None,
    ) -> BlendGradients:
        """The gradients of the visible points from dL/dfeatures (H, W, 16) of result.features; with
        alpha compositing also from dL/dalpha (H * W,), and from the distortion loss of each sample
        times distortion_weight (cl/raster/blend.cl). with_offsets: also compute gradients of
        offsets, if soft points or Gaussians are composited by alpha. depth_gradient, max_weight: as
        for blend_backward().

        result: from the last forward(training=True). The gradients of the SH coefficients are those
        of the visible points' features times the basis functions in the view's direction; the
        optimiser multiplies the two when it updates a coefficient, and never stores the products.
        """
        settings = self.settings
        kind = FOOTPRINTS[settings.footprint]
        moves = with_offsets and settings.blend == "alpha" and kind.moves
        with self.dev.stage("backward"):
            return blend_backward(
                self.dev,
                self._buffers,
                result.points,
                result.pairs,
                result.weights,
                visible_features=result.visible_features,
                features=result.features,
                grad_features=grad_features,
                grad_alpha=grad_alpha,
                distortion_weight=distortion_weight,
                depth_gradient=depth_gradient,
                voxel_size=self.model.grid.voxel_size if moves else 0.0,
                max_weight=max_weight,
            )

    def blend(self, result: RenderResult, features: np.ndarray) -> np.ndarray:
        """(H, W, 16) float32, without padding: features (S, 16) of the visible points
        result.weights.visible, blended by a view's weights. Overwrites result's features.

        result: from the last forward(training=True).
        """
        self.dev.write(result.visible_features[: len(features)], features)
        view = result.points, result.pairs, result.weights
        blend_forward(self.dev, self._buffers, *view, result.visible_features, result.features)
        return result.cropped(self.dev.download(result.features))

    def gather(self, result: RenderResult, pixels: np.ndarray) -> np.ndarray:
        """(S, 16) float32, the transpose of blend(): for each visible point the sum of pixels (H,
        W, 16), without padding, times the point's weights there.
        """
        padded = np.zeros((*result.size, 16), np.float32)
        result.cropped(padded)[:] = pixels
        weights = result.weights  # of all fragments
        result.weights = replace(weights, sample_tracked=weights.sample_end)
        gradients = self.backward_features(result, self.dev.upload(padded))
        return self.dev.download(gradients.visible_features[: result.weights.visible.size])

    def record_weights(
        self,
        result: RenderResult,
        max_weight: Array,
        times_seen: Array,
        *,
        least: float = 0.0,
    ) -> None:
        """Update max_weight and times_seen by the last forward(until="weights"), as
        highest_weights.py has it.
        """
        view = result.points, result.pairs, result.weights
        record_weights(self.dev, self._buffers, *view, max_weight, times_seen, least)

    def render(self, camera: Camera, gamma: float, **options) -> np.ndarray:
        """(H, W, 3) float32 numpy image of a camera, clamped to [0, 1]. options: for forward()."""
        return self.forward(camera, gamma, **options).clamped()
