"""Float64 twin of the network, written out layer by layer, in the plain (CO, CI, K, K) layout of
weights. That of the bench, pp_cl/reference/network.py, walks the network's own list of layers.
"""

import numpy as np

from pp_cl.reference.network import (
    convolution,
    convolution_backward_weights,
    flipped,
    gate,
    gate_backward,
    pool,
    pool_backward,
    upsample,
    upsample_backward,
)

LAST = {"double": ".b", "single": ".a", "gated": ".gate"}  # of a block's layers


def unet(x, parameters, blocks="double"):
    """(y (H, W, 3), {layer: its output}) for parameters {"enc0.a.weight": (CO, CI, K, K),
    "enc0.a.bias": (CO,), ...}.
    """

    def layer(name, *sources, relu=True):
        weight, bias = parameters[name + ".weight"], parameters[name + ".bias"]
        out = convolution(np.concatenate(sources, 2), weight, bias)
        return np.maximum(out, 0) if relu else out

    def block(name, *sources):
        a[name + ".a"] = layer(name + ".a", *sources, relu=blocks != "gated")
        if blocks == "double":
            a[name + ".b"] = layer(name + ".b", a[name + ".a"])
        if blocks == "gated":
            a[name + ".gate"] = gate(a[name + ".a"])
        return a[name + LAST[blocks]]

    a = {"x": np.asarray(x, np.float64)}
    skip0 = block("enc0", a["x"])
    a["pool0"] = pool(skip0)
    skip1 = block("enc1", a["pool0"])
    a["pool1"] = pool(skip1)
    # enlarged before the 1x1 convolution, as the paper has it: the same function
    a["wide1"] = upsample(block("enc2", a["pool1"]))
    a["up1"] = layer("up1", a["wide1"], relu=False)
    a["wide0"] = upsample(block("dec1", a["up1"], skip1))
    a["up0"] = layer("up0", a["wide0"], relu=False)
    return 0.5 + 0.5 * layer("out", block("dec0", a["up0"], skip0), relu=False), a


def unet_gradients(x, parameters, grad_y, blocks="double"):
    """(grad_x, {name: gradient}) by the chain rule, the same keys as parameters."""
    _, a = unet(x, parameters, blocks)
    gradients, last = {}, LAST[blocks]

    def back(name, grad_out, *sources):
        """Gradient of the sources' concatenation; grad_out is that of the layer before its ReLU."""
        joined = np.concatenate([a[s] for s in sources], 2)
        weight = parameters[name + ".weight"]
        gradients[name + ".weight"] = convolution_backward_weights(
            joined, grad_out, weight.shape[2]
        )
        gradients[name + ".bias"] = grad_out.sum((0, 1))
        return convolution(grad_out, flipped(weight))

    def relu(name, grad):
        return grad * (a[name] > 0)

    def back_block(name, grad, *sources):
        """Gradient of the sources' concatenation, given that of the block's output."""
        if blocks == "double":
            grad = back(name + ".b", relu(name + ".b", grad), name + ".a")
        first = name + ".a"
        grad = gate_backward(a[first], grad) if blocks == "gated" else relu(first, grad)
        return back(first, grad, *sources)

    grad = back("out", 0.5 * np.asarray(grad_y, np.float64), "dec0" + last)
    grad, skip0 = np.split(back_block("dec0", grad, "up0", "enc0" + last), 2, 2)
    grad = upsample_backward(back("up0", grad, "wide0"))
    grad, skip1 = np.split(back_block("dec1", grad, "up1", "enc1" + last), 2, 2)
    grad = upsample_backward(back("up1", grad, "wide1"))
    grad = skip1 + pool_backward(back_block("enc2", grad, "pool1"))
    grad = skip0 + pool_backward(back_block("enc1", grad, "pool0"))
    return back_block("enc0", grad, "x"), gradients
