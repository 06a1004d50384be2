"""`pp-cl bench unet`: time against error of whole networks, by variant of the convolutions."""

from collections.abc import Callable, Iterator

import numpy as np
from pyopencl.array import Array

from pp_cl.bench.timing import errors, variant_rows
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.choice import AUTO, OFFERED, device_class
from pp_cl.engine.layers.conv import unpack_weights
from pp_cl.engine.network.layers import multiplications
from pp_cl.engine.network.unet import Network, UNet
from pp_cl.reference import network as reference

CHANNELS_IN, CHANNELS_OUT = 16, 3
CHECK_SIZE = 128  # float64 takes seconds for each variant of the paper's network at this size


def bench_unet(
    dev: Device, size: int, widths: tuple[int, int, int], *, blocks: str = "double"
) -> Iterator[dict]:
    """Yield rows for the whole network at size x size, as shipped and with every variant:
    "forward"; and "train", which is forward and backward to input and weights, with the errors of
    the worst gradient.
    """
    rng = np.random.default_rng(0)
    x = np.maximum(rng.normal(size=(size, size, CHANNELS_IN)), 0).astype(np.float32)
    grad_image = rng.normal(size=(size, size, CHANNELS_OUT)).astype(np.float32)
    names = (AUTO, *OFFERED[device_class(dev)])
    nets = {name: make_network(dev, widths, name, blocks) for name in names}
    net = nets[AUTO]
    parameters = plain_parameters(net, net.parameters)
    outputs = reference.network(net.layers, parameters, x[:CHECK_SIZE, :CHECK_SIZE])
    part = grad_image[:CHECK_SIZE, :CHECK_SIZE]
    errors_of = {
        name: network_errors(nets[name], outputs=outputs, grad_image=part) for name in names
    }
    device_x, device_grad = dev.upload(x), dev.upload(grad_image)
    flops = 2 * multiplications(net.layers, size, size)
    for direction, factor, grad in (("forward", 1, None), ("train", 3, device_grad)):
        about = {
            "layer": "network",
            "shape": [size, size, CHANNELS_IN, *widths, CHANNELS_OUT],
            "blocks": blocks,
            "direction": direction,
        }
        yield from variant_rows(
            about,
            {name: network_runner(nets[name], device_x, grad) for name in names},
            {name: errors_of[name][direction] for name in names},
            flops=factor * flops,
        )


def make_network(
    dev: Device, widths: tuple[int, int, int], variant: str = AUTO, blocks: str = "double"
) -> UNet:
    """A network with a variant and He's initial weights. With UNet's own, values fade through the
    layers, and as the image is little else than 0.5, its error says nothing.
    """
    net = UNet(dev, widths, blocks=blocks, variant=variant)
    for name, parameter in net.parameters.items():
        if name.endswith(".weight"):
            dev.write(parameter, np.float32(np.sqrt(6)) * parameter.get())
    return net


def network_runner(net: UNet, x: Array, grad_image: Array | None = None) -> Callable:
    """A function that makes an image, and with grad_image also all gradients, and waits."""

    def run():
        net.forward(x, training=grad_image is not None)
        if grad_image is not None:
            net.sum_gradients(net.backward(grad_image)[1])
        net.dev.finish()

    return run


def plain_parameters(net: Network, arrays: dict[str, Array]) -> dict[str, np.ndarray]:
    """{name: (CO, CI, K, K) or (CO,) numpy array} of a network's parameters or gradients."""
    channels, plain = {layer.name: layer.channels for layer in net.layers}, {}
    for name, array in arrays.items():
        values, co = array.get(), channels[name.rsplit(".", 1)[0]]
        plain[name] = unpack_weights(values, co) if values.ndim == 5 else values[:co]
    return plain


def network_errors(
    net: UNet, *, outputs: dict, grad_image: np.ndarray
) -> dict[str, tuple[float, float]]:
    """{"forward", "train": errors}. outputs: from reference.network(); grad_image: (H, W, 3)."""
    dev = net.dev
    parameters = plain_parameters(net, net.parameters)
    image = net.forward(dev.upload(outputs["x"], np.float32)).get()
    active = {layer.name: net.output(layer.name).get() > 0 for layer in net.layers if layer.relu}
    grad_x, parts = net.backward(dev.upload(grad_image))
    actual = {"x": grad_x.get()} | plain_parameters(net, net.sum_gradients(parts))
    expected = reference.network_gradients(
        net.layers, parameters, outputs, active, grad_image=grad_image
    )
    return {
        "forward": errors(image, outputs["image"]),
        "train": max(errors(actual[name], expected[name]) for name in expected),
    }
