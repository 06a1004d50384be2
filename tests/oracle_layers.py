"""Float64 twins of cl/layers.cl and of the whole network; gradients are exact transposes."""

import numpy as np
from oracle_conv import conv, conv_gradients


def avgpool2(x):
    """(2H, 2W, C) -> (H, W, C)."""
    h, w, c = x.shape
    return np.asarray(x, np.float64).reshape(h // 2, 2, w // 2, 2, c).mean((1, 3))


def avgpool2_gradient(grad_out):
    """(H, W, C) -> (2H, 2W, C)."""
    return 0.25 * np.asarray(grad_out, np.float64).repeat(2, 0).repeat(2, 1)


def maxpool2(x):
    """(H, W, C) -> (H // 2, W // 2, C)."""
    h, w, c = x.shape[0] // 2, x.shape[1] // 2, x.shape[2]
    return np.asarray(x, np.float64)[:2 * h, :2 * w].reshape(h, 2, w, 2, c).max((1, 3))


def upsample_matrix(n):
    """(2n, n): row i holds the weights of output i, from the definition by coordinates (i + 0.5) / 2 - 0.5."""
    matrix = np.zeros((2 * n, n))
    for i in range(2 * n):
        position = min(max((i + 0.5) / 2 - 0.5, 0), n - 1)
        low = int(position)
        high = min(low + 1, n - 1)
        matrix[i, low] += 1 - (position - low)
        matrix[i, high] += position - low
    return matrix


def upsample2(x):
    """(H, W, C) -> (2H, 2W, C)."""
    return np.einsum("Yy,Xx,yxc->YXc", upsample_matrix(x.shape[0]), upsample_matrix(x.shape[1]), np.asarray(x, np.float64),
                     optimize=True)


def upsample2_gradient(grad_out):
    """(2H, 2W, C) -> (H, W, C)."""
    h, w = grad_out.shape[0] // 2, grad_out.shape[1] // 2
    return np.einsum("Yy,Xx,YXc->yxc", upsample_matrix(h), upsample_matrix(w), np.asarray(grad_out, np.float64), optimize=True)


def unet(x, parameters):
    """(y (H, W, 3), activations) of the network for parameters {"enc0.a.weight": (CO, CI, K, K), "enc0.a.bias": (CO,), ...}."""
    def layer(name, *sources, relu=True):
        return conv(np.concatenate(sources, 2), parameters[name + ".weight"], parameters[name + ".bias"], relu)

    a = {"x": np.asarray(x, np.float64)}
    a["enc0.a"] = layer("enc0.a", a["x"])
    a["enc0.b"] = layer("enc0.b", a["enc0.a"])
    a["pool0"] = avgpool2(a["enc0.b"])
    a["enc1.a"] = layer("enc1.a", a["pool0"])
    a["enc1.b"] = layer("enc1.b", a["enc1.a"])
    a["pool1"] = avgpool2(a["enc1.b"])
    a["enc2.a"] = layer("enc2.a", a["pool1"])
    a["enc2.b"] = layer("enc2.b", a["enc2.a"])
    a["up1"] = layer("up1", upsample2(a["enc2.b"]), relu=False)  # the other order than the product's
    a["dec1.a"] = layer("dec1.a", a["up1"], a["enc1.b"])
    a["dec1.b"] = layer("dec1.b", a["dec1.a"])
    a["up0"] = layer("up0", upsample2(a["dec1.b"]), relu=False)
    a["dec0.a"] = layer("dec0.a", a["up0"], a["enc0.b"])
    a["dec0.b"] = layer("dec0.b", a["dec0.a"])
    return 0.5 + 0.5 * layer("out", a["dec0.b"], relu=False), a


def unet_gradients(x, parameters, grad_y):
    """(grad_x, gradients) of the network by the chain rule, same keys as parameters."""
    _, a = unet(x, parameters)
    gradients = {}

    def layer(name, grad_out, *sources):
        """Gradients of the sources; grad_out is taken before the ReLU."""
        joined = np.concatenate([a[s] for s in sources], 2) if sources[0] in a else sources[0]
        grad, gradients[name + ".weight"], gradients[name + ".bias"] = conv_gradients(joined, parameters[name + ".weight"], grad_out)
        return grad

    def relu(name, grad):
        return grad * (a[name] > 0)

    grad = relu("dec0.b", layer("out", 0.5 * np.asarray(grad_y, np.float64), "dec0.b"))
    grad = relu("dec0.a", layer("dec0.b", grad, "dec0.a"))
    grad = layer("dec0.a", grad, "up0", "enc0.b")
    c = a["up0"].shape[2]
    skip0, grad = grad[..., c:], upsample2_gradient(layer_up("up0", grad[..., :c], a["dec1.b"], parameters, gradients))
    grad = relu("dec1.a", layer("dec1.b", relu("dec1.b", grad), "dec1.a"))
    grad = layer("dec1.a", grad, "up1", "enc1.b")
    c = a["up1"].shape[2]
    skip1, grad = grad[..., c:], upsample2_gradient(layer_up("up1", grad[..., :c], a["enc2.b"], parameters, gradients))
    grad = relu("enc2.a", layer("enc2.b", relu("enc2.b", grad), "enc2.a"))
    grad = relu("enc1.b", skip1 + avgpool2_gradient(layer("enc2.a", grad, "pool1")))
    grad = relu("enc1.a", layer("enc1.b", grad, "enc1.a"))
    grad = relu("enc0.b", skip0 + avgpool2_gradient(layer("enc1.a", grad, "pool0")))
    grad = relu("enc0.a", layer("enc0.b", grad, "enc0.a"))
    return layer("enc0.a", grad, "x"), gradients
