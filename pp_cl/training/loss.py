"""The training loss: L1 + weight * (1 - SSIM), and its gradient."""

from types import SimpleNamespace

WINDOW = 11  # pixels, the side of an SSIM window


class Loss:
    """L = mean |p - t| + ssim_weight * (1 - SSIM(p, t)) over an image; holds its scratch buffers.

    SSIM (Wang et al. 2004): 11x11 Gaussian windows of sigma 1.5 inside the image, k1 .01, k2 .03,
    range 1, population variances, mean over channels and windows. It is off (its term reads 0)
    where ssim_weight is 0 or a side of the target is below 11 pixels. terms: (4,) float32 on the
    device after a call: L, L1, 1 - SSIM, mean squared error.
    """

    def __init__(self, dev, ssim_weight):
        self.dev = dev
        self.ssim_weight = ssim_weight
        self.terms = dev.zeros((4,))
        self._sizes = None

    def forward_backward(self, prediction, target, left=0, top=0):
        """dL/dprediction, (PH, PW, 3) float32, valid until the next call; sets `terms`.

        prediction: (PH, PW, 3) float32, unclamped. target: (H, W, 3) float32, lies on the
        prediction's columns left..left+W and rows top..top+H; the gradient is 0 elsewhere. Raises
        ValueError where it reaches outside.
        """
        (height, width, _), (prediction_height, prediction_width, _) = (
            target.shape,
            prediction.shape,
        )
        if (
            min(left, top) < 0
            or left + width > prediction_width
            or top + height > prediction_height
        ):
            raise ValueError(
                f"target {target.shape} at ({left}, {top}) reaches outside the prediction"
                f" {prediction.shape}"
            )
        self._prepare(prediction.shape, target.shape)
        b = self._buffers
        images = {
            "prediction": prediction,
            "target": target,
            "pw": prediction_width,
            "w": width,
            "corner": 3 * (top * prediction_width + left),
        }
        rows = {"v": b.window_rows, "blocks": b.blocks}
        size = (b.blocks, b.window_rows)
        launch = self.dev.program("training/loss").launch
        launch("loss_moments", size, moments=b.moments, **images, **rows)
        launch(
            "loss_similarity",
            size,
            w=width,
            weight=self.ssim_weight,
            moments=b.moments,
            slopes=b.slopes,
            partial_terms=b.partial_terms,
            **rows,
        )
        launch("loss_spread", size, slopes=b.slopes, spread=b.spread, **rows)
        if prediction.shape != target.shape:
            self.dev.fill(b.grad_prediction, 0)
        launch(
            "loss_gradient",
            (b.blocks, height),
            h=height,
            spread=b.spread,
            grad_prediction=b.grad_prediction,
            partial_terms=b.partial_terms,
            **images,
            **rows,
        )
        n = b.window_rows + height
        launch("loss_sum", n, rows=n, m=b.blocks, terms=b.partial_terms, sums=b.row_terms)
        launch(
            "loss_sum",
            1,
            rows=1,
            m=n,
            terms=b.row_terms.reshape(1, n, 4),
            sums=self.terms.reshape(1, 4),
        )
        return b.grad_prediction

    def _prepare(self, prediction_shape, target_shape):
        """Allocate for these sizes, unless the last call had the same."""
        if self._sizes == (prediction_shape, target_shape):
            return
        height, width, _ = target_shape
        has_ssim = self.ssim_weight != 0 and min(height, width) >= WINDOW
        window_rows = height - WINDOW + 1 if has_ssim else 0
        blocks = -(-3 * width // 16) + 2  # float16 in a scratch row, with the kernels' margin
        empty = self.dev.empty
        self._buffers = SimpleNamespace(
            window_rows=window_rows,
            blocks=blocks,
            moments=empty((window_rows, 4, blocks, 16)),
            slopes=empty((window_rows, 3, blocks, 16)),
            spread=empty((window_rows, 3, blocks, 16)),
            partial_terms=empty((window_rows + height, blocks, 4)),
            row_terms=empty((window_rows + height, 4)),
            grad_prediction=empty(prediction_shape),
        )
        self._sizes = (prediction_shape, target_shape)
