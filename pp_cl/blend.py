"""The blend of Eq. (1): weights, features, and their gradients."""

ALL = 2**32 - 1
BACKGROUND = 1.0  # every feature of a pixel without hits (cl/blend.cl)


class Blend:
    """Blends the hits of a Pairs object; keeps the weights of the view blended last.

    pair_weight: (P,2) float32, see cl/blend.cl. mean: gradients are means over a point's pixels, as Pulsar's, not sums.
    """

    def __init__(self, dev, footprint, mean=False):
        self.dev = dev
        self.program = dev.program("blend", MEAN=int(mean), **footprint.defines)
        self.pair_weight = self.pixel_dot = None

    def weights(self, pairs, view, opacity, gamma, max_tracked=0, stop=0.0):
        """Weigh all pairs. Overwrites pairs.hit with each pixel's list of weights and points.

        view: (20) packed camera. opacity: (N) in [0, 1]. max_tracked: only so many nearest hits of a pixel get gradients
        (64 in the paper); 0: all. stop: Pulsar's percent_allowed_difference in [0, 1), 0.001 in the paper: a pixel drops
        the hits behind the depth where none can have this share any more; 0: none.
        """
        self.pair_weight = self._reuse(self.pair_weight, (pairs.capacity, 2))
        self.program.launch(
            "blend_weights", pairs.pixels, hw=pairs.pixels, max_tracked=max_tracked or ALL, gamma=gamma, least=stop,
            camera=view, pixel_offset=pairs.pixel_offset, pair_key=pairs.pair_key, point_from_pair=pairs.point_from_pair,
            opacity=opacity, pair_closeness=pairs.pair_closeness, pair_weight=self.pair_weight, hit=pairs.hit)

    def forward(self, pairs, point_features, features):
        """Write features (H,W,16) from point_features (N,16), of which only the seen rows are read."""
        self.program.launch(
            "blend_forward", pairs.pixels, hw=pairs.pixels, pixel_offset=pairs.pixel_offset, hit=pairs.hit,
            point_features=point_features, features=features)

    def backward(self, pairs, point_features, features, grad_features, grad_point_features, grad_opacity):
        """Write grad_point_features (N,16) and grad_opacity (N), zeros for unseen points.

        features: (H,W,16), the result of forward. grad_features: (H,W,16).
        """
        self.program.launch(
            "blend_backward", pairs.points, n=pairs.points, grad_point_features=grad_point_features,
            grad_opacity=grad_opacity, **self._slopes(pairs, point_features, features, grad_features))

    def backward_spheres(self, pairs, view, gamma, point_radius, point_camera, opacity, point_features, features,
                         grad_features, grad_positions, grad_radius):
        """Write grad_positions (N,3), world axes, and grad_radius (N) of explicit spheres.

        point_radius: (1) or (N). point_camera: (N,4) from project. The rest as for weights and backward.
        """
        n, grad_pair = pairs.points, self.dev.empty((pairs.capacity, 2))
        self.program.launch("blend_backward_pairs", n, n=n, pair_closeness=pairs.pair_closeness, grad_pair=grad_pair,
                            **self._slopes(pairs, point_features, features, grad_features))
        self.program.launch(
            "blend_backward_spheres", n, n=n, k=point_radius.size, gamma=gamma, camera=view, point_radius=point_radius,
            point_camera=point_camera, opacity=opacity, point_offset=pairs.point_offset, pair_pixel=pairs.pair_pixel,
            grad_pair=grad_pair, grad_positions=grad_positions, grad_radius=grad_radius)

    def add_point_weights(self, pairs, point_weight):
        """Add to point_weight (N) the sum of each point's weights over the pixels."""
        self.program.launch(
            "blend_point_weights", pairs.points, n=pairs.points, point_offset=pairs.point_offset,
            pair_weight=self.pair_weight, point_weight=point_weight)

    def _slopes(self, pairs, point_features, features, grad_features):
        """The arguments from which the backward kernels take dL/db = G.(f - F) of each pair; computes G.F."""
        self.pixel_dot = self._reuse(self.pixel_dot, (pairs.pixels,))
        self.program.launch("blend_backward_pixels", pairs.pixels, hw=pairs.pixels, features=features,
                            grad_features=grad_features, pixel_dot=self.pixel_dot)
        return {"point_features": point_features, "point_offset": pairs.point_offset, "pair_pixel": pairs.pair_pixel,
                "pair_weight": self.pair_weight, "grad_features": grad_features, "pixel_dot": self.pixel_dot}

    def _reuse(self, array, shape):
        """`array` if it has this shape, else a new one."""
        return array if array is not None and array.shape == shape else self.dev.empty(shape)
