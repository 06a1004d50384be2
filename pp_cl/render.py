"""From a model and a camera to a picture, and back to gradients: the one place that writes the
order of the stages.

project -> pairs -> weights -> shade what is seen -> blend features -> U-Net
"""

import numpy as np

from pp_cl.raster.blend import BACKGROUND, Blend
from pp_cl.raster.blend_weights import Weights
from pp_cl.raster.pair_cache import PairCache
from pp_cl.raster.pairs import Pairs
from pp_cl.raster.project import Footprint, Projection
from pp_cl.raster.shade import shade_forward

NETWORK_MULTIPLE = 4  # the U-Net halves its input twice
WEIGHING = ("project", "pairs", "weights")  # the stages that need no features
# far - near of the scenes for which the paper's radius of 0.0015 was chosen
PAPER_DEPTH_RANGE = 4.0


class Renderer:
    """Renders a model; holds what the backward pass needs of the last forward pass.

    settings: config.RasterConfig. cache: keeps the hits of views with a key. offset: (left, top) of
    the asked-for picture in the padded one. camera: (20,) device buffer of the padded camera.
    """

    def __init__(self, dev, model, settings):
        self.dev = dev
        self.model = model
        self.settings = settings
        self.footprint = Footprint(settings.footprint)
        self.projection = Projection(dev, self.footprint)
        self.pairs = Pairs(dev, self.footprint)
        self.cache = PairCache(dev)
        self.weights = Weights(dev)
        self.blend = Blend(dev, self.footprint, mean=settings.mean_gradient)
        self.offset = (0, 0)
        self.camera, self.radius_buffer = dev.empty((20,)), dev.empty((1,))
        self._count = self._size = None

    def forward(self, camera, gamma, dropout=0.0, seed=0, training=False, key=None):
        """(H, W, 3) device array, unclamped, of the camera padded to a multiple of 4; see `offset`.

        dropout: share of the points left out, at random by `seed`. training: keep what backward()
        needs. key: of a view whose camera and points are the same in every call until
        cache.clear(), so that its hits may be kept.
        """
        for stage in self.stages(camera, gamma, dropout, seed, key).values():
            stage()
        return self.model.net.forward(self.features, training, BACKGROUND)

    def blend_weights(self, camera, gamma):
        """The first stages of forward(): who covers which pixel, and how much."""
        stages = self.stages(camera, gamma)
        for name in WEIGHING:
            stages[name]()

    def stages(self, camera, gamma, dropout=0.0, seed=0, key=None):
        """{name: function} of forward()'s stages from the points to self.features (H, W, 16), in
        their order.
        """
        padded, *self.offset = camera.padded(NETWORK_MULTIPLE)
        size = (padded.height, padded.width)
        self._allocate(*size)
        self.camera.set(padded.packed())
        points, settings, pairs, weights = (
            self.model.points,
            self.settings,
            self.pairs,
            self.weights,
        )
        radius = self._radius(padded)
        self.radius_buffer.set(np.array([radius], np.float32))
        sh = [points[block.name] for block in self.model.blocks]
        return {
            "project": lambda: self.projection.grid(
                self.camera, self.model.grid_buffer, points["ids"], radius, dropout, seed
            ),
            "pairs": lambda: self.cache.build(
                key, pairs, self.camera, size, self.projection, self.radius_buffer
            ),
            "weights": lambda: weights.weigh(
                pairs,
                self.camera,
                points["opacity"],
                gamma,
                settings.max_tracked,
                settings.early_stop,
                settings.tau,
            ),
            "shade": lambda: shade_forward(
                self.dev,
                self.camera,
                self.projection.point_camera,
                weights.kept,
                sh,
                self.point_features,
            ),
            "blend": lambda: self.blend.forward(pairs, self.point_features, self.features),
        }

    def backward(self, grad_image):
        """(grad_point_features (N,16), grad_opacity (N)) from the gradient of forward()'s picture.

        The gradients of the network's parameters lie in model.net.gradients; those of the SH
        coefficients are rank one in grad_point_features, and the optimiser never forms them.
        """
        return self.backward_features(self.model.net.backward(grad_image))

    def backward_features(self, grad_features):
        """The same from the gradient of self.features (H, W, 16)."""
        self.blend.backward(
            self.pairs,
            self.weights.pair_weight,
            self.point_features,
            self.features,
            grad_features,
            self.grad_point_features,
            self.grad_opacity,
        )
        return self.grad_point_features, self.grad_opacity

    def add_point_weights(self, total):
        """Add each point's blend weight in the last picture to total (N)."""
        self.weights.add_point_weights(self.pairs, total)

    def picture(self, camera, gamma):
        """(H, W, 3) float32 numpy picture of the camera, clamped to [0, 1]."""
        image = self.forward(camera, gamma).get()
        left, top = self.offset
        return np.clip(image[top : top + camera.height, left : left + camera.width], 0, 1)

    def _radius(self, camera):
        """The points' radius in world units for a camera."""
        if self.settings.footprint == "soft":
            return self.settings.radius * self.model.grid.edge
        return self.settings.radius * (camera.far - camera.near) / PAPER_DEPTH_RANGE

    def _allocate(self, height, width):
        """Buffers for the model's present number of points and this size."""
        n = self.model.count
        if n != self._count:
            self._count = n
            # released first
            self.point_features = self.grad_point_features = self.grad_opacity = None
            self.point_features = self.dev.empty((n, 16))
            self.grad_point_features, self.grad_opacity = (
                self.dev.empty((n, 16)),
                self.dev.empty((n,)),
            )
        if (height, width) != self._size:
            self._size = (height, width)
            self.features = self.dev.empty((height, width, 16))
