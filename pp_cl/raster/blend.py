"""The blend of Eq. (1): features, and the gradients, by gathering."""

BACKGROUND = 1.0  # every feature of a pixel without hits (cl/raster/blend.cl)


class Blend:
    """Blends the hits of a Pairs object by their weights (Weights).

    mean: gradients are means over a point's pixels, as Pulsar's, not sums.
    """

    def __init__(self, dev, footprint, mean=False):
        self.dev = dev
        self.program = dev.program("raster/blend", MEAN=int(mean), **footprint.defines)
        self.pixel_dot = None

    def forward(self, pairs, point_features, features):
        """Write features (H,W,16) from point_features (N,16), of which only the rows of
        Weights.kept are read.
        """
        self.program.launch(
            "blend_forward",
            pairs.pixels,
            hw=pairs.pixels,
            pixel_offset=pairs.pixel_offset,
            hit=pairs.hit,
            point_features=point_features,
            features=features,
        )

    def backward(
        self,
        pairs,
        pair_weight,
        point_features,
        features,
        grad_features,
        grad_point_features,
        grad_opacity,
    ):
        """Write grad_point_features (N,16) and grad_opacity (N), zeros for unseen points.

        pair_weight: (P,2) of Weights. features: (H,W,16), the result of forward. grad_features:
        (H,W,16).
        """
        self.program.launch(
            "blend_backward",
            pairs.points,
            n=pairs.points,
            grad_point_features=grad_point_features,
            grad_opacity=grad_opacity,
            **self._slopes(pairs, pair_weight, point_features, features, grad_features),
        )

    def backward_spheres(
        self,
        pairs,
        pair_weight,
        view,
        gamma,
        point_radius,
        point_camera,
        opacity,
        point_features,
        features,
        grad_features,
        grad_positions,
        grad_radius,
    ):
        """Write grad_positions (N,3), world axes, and grad_radius (N) of explicit spheres.

        point_radius: (1) or (N). point_camera: (N,4) from project. The rest as for Weights.weigh
        and backward.
        """
        n, grad_pair = pairs.points, self.dev.empty(pair_weight.shape)
        self.program.launch(
            "blend_backward_pairs",
            n,
            n=n,
            pair_source=pairs.pair_source,
            grad_pair=grad_pair,
            **self._slopes(pairs, pair_weight, point_features, features, grad_features),
        )
        self.program.launch(
            "blend_backward_spheres",
            n,
            n=n,
            k=point_radius.size,
            gamma=gamma,
            camera=view,
            point_radius=point_radius,
            point_camera=point_camera,
            opacity=opacity,
            point_offset=pairs.point_offset,
            pair_pixel=pairs.pair_pixel,
            grad_pair=grad_pair,
            grad_positions=grad_positions,
            grad_radius=grad_radius,
        )

    def _slopes(self, pairs, pair_weight, point_features, features, grad_features):
        """The arguments from which the backward kernels take dL/db = G.(f - F) of each pair;
        computes G.F.
        """
        if self.pixel_dot is None or self.pixel_dot.size != pairs.pixels:
            self.pixel_dot = self.dev.empty((pairs.pixels,))
        self.program.launch(
            "blend_backward_pixels",
            pairs.pixels,
            hw=pairs.pixels,
            features=features,
            grad_features=grad_features,
            pixel_dot=self.pixel_dot,
        )
        return {
            "point_features": point_features,
            "point_offset": pairs.point_offset,
            "pair_pixel": pairs.pair_pixel,
            "pair_weight": pair_weight,
            "grad_features": grad_features,
            "pixel_dot": self.pixel_dot,
        }
