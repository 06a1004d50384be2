"""Cases of the specular layer: its image, and the pixels to which it is fitted."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.conv import pack_bias, pack_weights
from pp_cl.engine.layers.simple import specular_forward
from pp_cl.engine.network.layers import convolutions
from pp_cl.engine.network.specular import INPUTS, Specular
from pp_cl.engine.render import RenderResult
from pp_cl.engine.training.specular import ROW, draw_batch, gradient_of_squares, keep_pixels
from pp_cl.reference import network
from pp_cl.selftest.case import EPS, SIZES, Case, each, exact, relative

BOUND = 2e-6  # sums of up to 58 products; errors of the double-angle formulas add up
HALF, LEAST = 2**-11 + 8 * EPS, 2**-14  # rounding to half, and the least half that has all bits
EXTENT = 1.7  # world units
WEIGHTS, FAR = (0.01, 0.9), (1.0, 9.0)  # blend weights and distances of fragments
PADDED = 2, 1  # (left, top) of an image within the rendered one


def random_layer(dev: Device, rng: np.random.Generator) -> tuple[Specular, dict[str, np.ndarray]]:
    """A layer, and its parameters for the float64 twin."""
    layer, parameters = Specular(dev), {}
    for convolution in convolutions(layer.layers):
        shape = convolution.weight_shape()
        weight, bias = rng.normal(size=shape) / np.sqrt(shape[1]), rng.normal(size=shape[0])
        for kind, values, packed in (
            ("weight", weight.astype(np.float32), pack_weights),
            ("bias", bias.astype(np.float32), pack_bias),
        ):
            parameters[f"{convolution.name}.{kind}"] = values.astype(np.float64)
            dev.write(layer.parameters[f"{convolution.name}.{kind}"], packed(values))
    return layer, parameters


def _view(dev, rng, height, width, side):
    """(a result like renderer.forward()'s with random pixels; directions and places of the pixels,
    (H, W, 3) each). Some pixels have alpha 0, 1, or less than the layer needs. The middle one looks
    along an axis. Lists of fragments have 1 to 4, of which an early stop may have dropped some.
    """
    pose = np.eye(3, 4)[[2, 0, 1]]
    sizes = width / 2, height / 2, width, height
    camera = Camera(pose, 0.9 * width, 1.1 * width, *sizes)
    alpha = rng.choice([0.0, 0.005, 0.01, 0.5, 1.0, -1.0], (height, width))
    alpha = np.where(alpha < 0, rng.random(alpha.shape), alpha)
    alpha[np.abs(alpha - 0.02) < 1e-3] = 1  # near the threshold, rounding may decide
    features, image = rng.normal(size=(height, width, 16)), rng.random((height, width, 3))
    rays = camera.rays()
    directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    ranges = rng.uniform(*FAR, height * width).astype(np.float32)
    mean = ranges.reshape(height, width, 1).astype(np.float64)
    view: Any = RenderResult(
        dev,
        camera,
        PADDED,
        (height, width),
        points=SimpleNamespace(camera_buffer=dev.upload(camera.enlarged(side).packed((1, 9)))),
        pairs=None,
        weights=SimpleNamespace(
            blend="alpha",
            transmittance=dev.upload(1 - alpha.ravel(), np.float32),
            mean_range=dev.upload(ranges),
        ),
        tile_mask=None,
        supersampling=side,
    )
    view.features, view.image = dev.upload(features, np.float32), dev.upload(image, np.float32)
    return view, directions, (camera.eye + mean * directions) / EXTENT


def _forward(dev, rng):
    """Images whose pixels show the object fully, partly, too little or not at all."""
    layer, parameters = random_layer(dev, rng)
    for n in SIZES:
        for height, width, side in ((1, n, 1), (n, 3, 2)):
            view, directions, places = _view(dev, rng, height, width, side)
            before = view.image.get()
            specular_forward(dev, layer.parameters, view.image, view.specular_arguments(EXTENT))
            alpha = 1 - view.transmittance.get().reshape(height, width, 1).astype(np.float64)
            of_pixels = view.features.get(), directions, places
            added = network.specular(layer.layers, parameters, *of_pixels)
            is_shown = alpha[..., 0] >= 0.02
            yield relative(
                view.image.get(), before + np.where(alpha >= 0.02, alpha * added, 0), BOUND
            )
            yield exact(view.image.get()[~is_shown], before[~is_shown])


def _batches(dev, rng):
    """The pixels kept from two views, batches of them, and a step's gradient."""
    for n in SIZES:
        rows = dev.zeros((2 * n + 1, ROW), np.float16)
        expected = np.zeros(rows.shape)
        for first, side in ((0, 1), (n + 1, 2)):
            view, *rays = _view(dev, rng, n + 3, 9, side)
            left, top = PADDED
            target = rng.random((n, 5, 3)).astype(np.float32)
            y, x = top + np.arange(n), left + rng.integers(0, 5, n)
            chosen = (9 * y + x).astype(np.uint32)
            keep_pixels(view, chosen, dev.upload(target), rows, first, EXTENT)
            alpha = 1 - view.transmittance.get().reshape(n + 3, 9)[y, x, None].astype(np.float64)
            missing = target[y - top, x - left].astype(np.float64) - view.image.get()[y, x]
            with np.errstate(divide="ignore"):
                lacking = np.where(alpha > 0, missing / alpha, np.inf * np.sign(missing))
            of_pixels = view.features.get()[y, x], *(of_all[y, x] for of_all in rays), lacking
            expected[first : first + n] = np.concatenate(of_pixels, -1)
        stored = rows.get()
        usable = np.isfinite(expected).all(1)
        yield each(stored[usable], expected[usable], HALF, floor=LEAST)
        kept = np.where(usable[:, None], stored, 0)
        drawn, unit = rng.integers(0, len(kept), n).astype(np.uint32), 0.3
        inputs, wanted = dev.empty((n, 1, INPUTS)), dev.empty((n, 1, 3))
        draw_batch(dev, dev.upload(kept), dev.upload(drawn), unit, inputs, wanted)
        of_rows = kept[drawn].astype(np.float64)
        of_pixels, lacking = np.split(of_rows[:, :22], (16, 19), -1), of_rows[:, 22:]
        yield relative(inputs.get()[:, 0], network.specular_inputs(*of_pixels), 16 * EPS)
        yield relative(wanted.get()[:, 0], 0.5 + lacking / unit, 2 * EPS)
        image, gradient = dev.upload(rng.random((n, 1, 3)), np.float32), dev.empty((n, 1, 3))
        gradient_of_squares(dev, image, wanted, gradient)
        wrong = image.get().astype(np.float64) - wanted.get()
        yield relative(gradient.get(), 2 * wrong / wrong.size, 4 * EPS)


CASES = (
    Case("specular: layer of an image", _forward),
    Case("specular: pixels that it is fitted to", _batches),
)
