"""Float64 twin of the network's forward pass, written out layer by layer, in the plain (CO, CI, K,
K) layout of weights. pp_cl/reference/network.py walks the network's own list of layers.
"""

import numpy as np

from pp_cl.reference.network import convolution, gate, pool, upsample

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
