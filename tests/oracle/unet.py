"""Float64 twin of the network, written out layer by layer, in the plain (CO, CI, K, K) layout of
weights.
"""

import numpy as np

from oracle.conv import conv, conv_gradients
from oracle.layers import avgpool2, avgpool2_gradient, upsample2, upsample2_gradient


def unet(x, parameters):
    """(y (H, W, 3), {layer: its output}) for parameters {"enc0.a.weight": (CO, CI, K, K),
    "enc0.a.bias": (CO,), ...}.
    """

    def layer(name, *sources, relu=True):
        return conv(
            np.concatenate(sources, 2),
            parameters[name + ".weight"],
            parameters[name + ".bias"],
            relu,
        )

    a = {"x": np.asarray(x, np.float64)}
    a["enc0.a"] = layer("enc0.a", a["x"])
    a["enc0.b"] = layer("enc0.b", a["enc0.a"])
    a["pool0"] = avgpool2(a["enc0.b"])
    a["enc1.a"] = layer("enc1.a", a["pool0"])
    a["enc1.b"] = layer("enc1.b", a["enc1.a"])
    a["pool1"] = avgpool2(a["enc1.b"])
    a["enc2.a"] = layer("enc2.a", a["pool1"])
    a["enc2.b"] = layer("enc2.b", a["enc2.a"])
    # enlarged before the 1x1 convolution, as the paper has it: the same function
    a["wide1"] = upsample2(a["enc2.b"])
    a["up1"] = layer("up1", a["wide1"], relu=False)
    a["dec1.a"] = layer("dec1.a", a["up1"], a["enc1.b"])
    a["dec1.b"] = layer("dec1.b", a["dec1.a"])
    a["wide0"] = upsample2(a["dec1.b"])
    a["up0"] = layer("up0", a["wide0"], relu=False)
    a["dec0.a"] = layer("dec0.a", a["up0"], a["enc0.b"])
    a["dec0.b"] = layer("dec0.b", a["dec0.a"])
    return 0.5 + 0.5 * layer("out", a["dec0.b"], relu=False), a


def unet_gradients(x, parameters, grad_y):
    """(grad_x, {name: gradient}) by the chain rule, the same keys as parameters."""
    _, a = unet(x, parameters)
    gradients = {}

    def back(name, grad_out, *sources):
        """Gradient of the sources' concatenation; grad_out is that of the layer before its ReLU."""
        joined = np.concatenate([a[s] for s in sources], 2)
        grad, grad_weight, grad_bias = conv_gradients(
            joined, parameters[name + ".weight"], grad_out
        )
        gradients[name + ".weight"], gradients[name + ".bias"] = grad_weight, grad_bias
        return grad

    def relu(name, grad):
        return grad * (a[name] > 0)

    grad = relu("dec0.b", back("out", 0.5 * np.asarray(grad_y, np.float64), "dec0.b"))
    grad = relu("dec0.a", back("dec0.b", grad, "dec0.a"))
    grad, skip0 = np.split(back("dec0.a", grad, "up0", "enc0.b"), 2, 2)
    grad = relu("dec1.b", upsample2_gradient(back("up0", grad, "wide0")))
    grad = relu("dec1.a", back("dec1.b", grad, "dec1.a"))
    grad, skip1 = np.split(back("dec1.a", grad, "up1", "enc1.b"), 2, 2)
    grad = relu("enc2.b", upsample2_gradient(back("up1", grad, "wide1")))
    grad = relu("enc2.a", back("enc2.b", grad, "enc2.a"))
    grad = relu("enc1.b", skip1 + avgpool2_gradient(back("enc2.a", grad, "pool1")))
    grad = relu("enc1.a", back("enc1.b", grad, "enc1.a"))
    grad = relu("enc0.b", skip0 + avgpool2_gradient(back("enc1.a", grad, "pool0")))
    grad = relu("enc0.a", back("enc0.b", grad, "enc0.a"))
    return back("enc0.a", grad, "x"), gradients
