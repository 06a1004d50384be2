"""Float64 convolutions and U-Nets in numpy: what `pp-cl bench` measures errors against."""

from collections import defaultdict

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


def convolution(x, weight, bias=0.0):
    """(H, W, CO) float64 convolution of x (H, W, CI) by weight (CO, CI, K, K), stride 1, zero
    padding K // 2.
    """
    out = np.zeros((x.shape[0] * x.shape[1], len(weight)))
    for ky, kx, seen in _taps(x, weight.shape[2]):
        out += seen @ weight[:, :, ky, kx].T.astype(np.float64, order="C")
    return out.reshape(*x.shape[:2], -1) + bias


def convolution_at(x, weight, bias, pixels):
    """The same at some pixels, rows (P,) and columns (P,): (P, CO)."""
    k = weight.shape[2]
    windows = sliding_window_view(np.pad(x, _padding(k)), (k, k), (0, 1))[pixels]  # (P, CI, K, K)
    matrix = weight.reshape(len(weight), -1).astype(np.float64).T
    return windows.reshape(len(windows), -1).astype(np.float64) @ matrix + bias


def flipped(weight):
    """Weights (CI, CO, K, K) whose convolution of dL/dout is dL/dx."""
    return weight.transpose(1, 0, 2, 3)[:, :, ::-1, ::-1]


def weight_gradient(x, grad_out, k):
    """(CO, CI, K, K) float64 gradient of the weights; x: (H, W, CI), grad_out: (H, W, CO), or some
    channels of either.
    """
    columns = grad_out.reshape(-1, grad_out.shape[2]).astype(np.float64).T
    gradient = np.empty((len(columns), x.shape[2], k, k))
    for ky, kx, seen in _taps(x, k):
        gradient[:, :, ky, kx] = columns @ seen
    return gradient


def _padding(k):
    return (k // 2, k // 2), (k // 2, k // 2), (0, 0)


def _taps(x, k):
    """Yields (ky, kx, (H W, CI) float64: what each pixel sees through that tap)."""
    height, width, channels = x.shape
    padded = np.pad(np.asarray(x, np.float64), _padding(k))
    for ky in range(k):
        for kx in range(k):
            yield ky, kx, padded[ky : ky + height, kx : kx + width].reshape(-1, channels)


def network(steps, parameters, x):
    """{step: its float64 output} of the network of unet_steps; "image" is the image, "x" the input
    (H, W, C).

    parameters: {"enc0.a.weight": (CO, CI, K, K), "enc0.a.bias": (CO,), ...}.
    """
    outputs = {"x": np.asarray(x, np.float64)}
    for step in steps:
        source = _joined(step, outputs)
        if step.kind == "pool":
            out = source.reshape(source.shape[0] // 2, 2, source.shape[1] // 2, 2, -1).mean((1, 3))
        elif step.kind == "up":
            out = _along_both(_bilinear(source.shape[0]), _bilinear(source.shape[1]), source)
        else:
            out = convolution(
                source, parameters[step.name + ".weight"], parameters[step.name + ".bias"]
            )
        outputs[step.name] = np.maximum(out, 0) if step.kind == "conv3" else out
    outputs["image"] = 0.5 + 0.5 * outputs["out"]
    return outputs


def network_gradients(steps, parameters, outputs, active, grad_image):
    """{"x" or parameter: its gradient}, given the outputs of network() and dL/dimage (H, W, 3).

    active: {step: where its ReLU lets the gradient pass}. Near 0 two ways of rounding disagree
    about that, and one such place weighs more than the rounding of all others: pass those of the
    network that is to be judged.
    """
    gradients, grads = {}, defaultdict(float)  # of parameters; of outputs, summed over their uses
    grads["out"] = 0.5 * np.asarray(grad_image, np.float64)
    for step in reversed(steps):
        grad = grads.pop(step.name)
        if step.kind == "conv3":
            grad = grad * active[step.name]
        if step.kind == "pool":
            grad_source = 0.25 * grad.repeat(2, 0).repeat(2, 1)
        elif step.kind == "up":
            grad_source = _along_both(
                _bilinear(len(grad) // 2).T, _bilinear(grad.shape[1] // 2).T, grad
            )
        else:
            weight, source = parameters[step.name + ".weight"], _joined(step, outputs)
            gradients[step.name + ".weight"] = weight_gradient(source, grad, weight.shape[2])
            gradients[step.name + ".bias"] = grad.sum((0, 1))
            grad_source = convolution(grad, flipped(weight))
        first = 0
        for name in step.inputs:
            channels = outputs[name].shape[2]
            grads[name] = grads[name] + grad_source[..., first : first + channels]
            first += channels
    return gradients | {"x": grads["x"]}


def _joined(step, outputs):
    return (
        outputs[step.inputs[0]]
        if len(step.inputs) == 1
        else np.concatenate([outputs[n] for n in step.inputs], 2)
    )


def _bilinear(n):
    """(2n, n) matrix that doubles a line: weights 3/4 and 1/4, the border repeated."""
    matrix = np.zeros((2 * n, n))
    for i in range(2 * n):
        matrix[i, i // 2] += 0.75
        matrix[i, np.clip(i // 2 - 1 + 2 * (i % 2), 0, n - 1)] += 0.25
    return matrix


def _along_both(rows, columns, x):
    """Apply a matrix to the rows and one to the columns of x (H, W, C)."""
    return np.einsum("Yy,Xx,yxc->YXc", rows, columns, x, optimize=True)
