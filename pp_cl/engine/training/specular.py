"""Fits the specular layer of a model (network/specular.py) after the last step of its training, by
least squares over pixels of all views at once. The training itself cannot learn it: a step sees one
view, and the loss treats reflections as outliers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import Buffers, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.network.specular import INPUTS, Specular
from pp_cl.engine.render import Renderer, RenderResult
from pp_cl.engine.training.optim import NETWORK_EPS, adam_update, network_state_table
from pp_cl.engine.views import View, evenly

KERNELS = "training/specular"
SIDE = 64  # a batch has SIDE x SIDE pixels
ROW = 25  # values stored for a pixel: features, direction, place, residual
MOST_VIEWS, MOST_ROWS = 128, 2**19  # views rendered for the fit; pixels kept from all of them
LEAST_ALPHA = 0.5  # pixels below this alpha are not fitted to
RATE = 5e-3  # first learning rate; it falls to 0 along a cosine
STEPS = 600, 1500  # of a fit, at least and at most; a fold takes half of them
FOLDS = 3
LEAST_SCALE = 0.2  # a layer scaled by less than this is dropped


class Fitted(NamedTuple):
    """layer: None if it does not help on views that it was not fitted to. scale: the factor applied
    to its colours. before, after: mean squared residual of the pixels without the layer and with
    it.
    """

    layer: Specular | None
    scale: float
    before: float
    after: float


def fit_steps(iterations: int) -> int:
    """How many steps the fit takes after a training of this many steps: a fifth of them, within
    STEPS, so that the fit takes a few percent of the training's time.
    """
    return min(max(iterations // 5, STEPS[0]), STEPS[1])


def fit_table(dev: Device, pixels: int) -> Table:
    """The buffers of SpecularFit. pixels: the number of pixels of all views together."""
    image, most = ((SIDE, SIDE, 3), np.float32), dev.info["max_allocation_bytes"] // (2 * ROW)
    return {
        "rows": ((min(MOST_ROWS, pixels, most), ROW), np.float16),
        "drawn": ((SIDE * SIDE,), np.uint32),
        "inputs": ((SIDE, SIDE, INPUTS), np.float32),
        "wanted": image,
        "gradient": image,
    }


class SpecularFit:
    """Collects pixels, about the same number from each view, and fits a layer to them.

    renderer: renders the model without a layer. target(i): (h, w, 3) float32 on the device, the
    image that views[i] should give.
    """

    def __init__(
        self,
        renderer: Renderer,
        views: Sequence[View],
        target: Callable[[int], Array],
        gamma: float,
        seed: int,
    ) -> None:
        self.dev, self._seed = renderer.dev, seed
        self._buffers = Buffers(self.dev)
        looked_at = evenly(range(len(views)), MOST_VIEWS)
        cameras = [views[i].camera for i in looked_at]
        self._table = fit_table(self.dev, sum(camera.width * camera.height for camera in cameras))
        self._rows = self.dev.empty(*self._table.pop("rows"))
        most, rng = len(self._rows) // len(looked_at), np.random.default_rng(seed)
        counts: list[int] = []
        extent = renderer.model.extent
        for i in looked_at:
            rendered = renderer.forward(views[i].camera, gamma)
            chosen = _object_pixels(views[i], rendered)
            if len(chosen) > most:
                chosen = np.sort(rng.choice(chosen, most, replace=False))
            if len(chosen):
                keep_pixels(rendered, chosen, target(i), self._rows, sum(counts), extent)
            counts.append(len(chosen))
            del rendered  # else its arrays would stay beside the larger ones of the next view
        self._fold = np.repeat(np.arange(len(counts)) % FOLDS, counts)
        lacking = self.dev.download(self._rows[: sum(counts)])[:, -3:].astype(np.float32)
        self._before = float(np.mean(lacking**2, dtype=np.float64)) if len(lacking) else 0.0
        # the layer learns residuals in this unit, so that Adam's steps have the right size
        self._unit = 2 * math.sqrt(self._before)

    def fitted(self, steps: int) -> Fitted:
        """The layer, fitted in this many steps and scaled by the largest factor up to 1 that does
        not lose, in cross-validation, on views left out of the fit: twice the best one. Even these
        views have been trained on, so new ones lack more.
        """
        every, sums = np.arange(len(self._fold), dtype=np.uint32), np.zeros(2)
        for fold in range(FOLDS):
            is_out = self._fold == fold
            if is_out.any() and not is_out.all():
                sums += self._products(self._trained(every[~is_out], steps // 2), every[is_out])
        scale = min(1.0, max(0.0, 2 * float(sums[0] / sums[1]))) if sums[1] > 0 else 0.0
        if scale < LEAST_SCALE:
            return Fitted(None, scale, self._before, self._before)
        layer = self._trained(every, steps)
        rp, pp = self._products(layer, every) / (3 * len(every))
        layer.scale(scale * self._unit)
        after = self._before - 2 * scale * rp + scale**2 * pp
        return Fitted(layer, scale, self._before, float(after))

    def _trained(self, rows, steps):
        """A layer fitted to these rows."""
        dev, rng, layer = self.dev, np.random.default_rng(self._seed), Specular(self.dev)
        table = network_state_table(layer.all_parameters.size, is_averaged=False)
        moments = {kind: dev.zeros(*row) for kind, row in table.items()}
        for step in range(steps):
            inputs, wanted = self._batch(rows[rng.integers(0, len(rows), SIDE * SIDE)])
            image, gradient = layer.forward(inputs), self._buffers.gradient
            gradient_of_squares(dev, image, wanted, gradient)
            _, parts = layer.backward(gradient)
            rate = RATE * (1 + math.cos(math.pi * step / steps)) / 2
            adam_update(
                dev,
                layer.all_parameters,
                parts,
                moments,
                step=step + 1,
                rate=rate,
                eps=NETWORK_EPS,
            )
        return layer

    def _products(self, layer, rows):
        """(2,) float64: the sums of r p and of p p over these rows, with their residuals r and the
        predictions p of the layer.
        """
        sums, size = np.zeros(2), SIDE * SIDE
        for start in range(0, len(rows), size):
            part = rows[start : start + size]
            inputs, wanted = self._batch(np.resize(part, size))
            p, r = (
                self._unit
                * (self.dev.download(array).reshape(-1, 3)[: len(part)] - np.float64(0.5))
                for array in (layer.forward(inputs, training=False), wanted)
            )
            sums += (r * p).sum(), (p * p).sum()
        return sums

    def _batch(self, rows):
        """(inputs, wanted images) of SIDE * SIDE rows, on the device."""
        b = self._buffers
        b.require(self._table)
        self.dev.send(b.drawn, rows)
        draw_batch(self.dev, self._rows, b.drawn, self._unit, b.inputs, b.wanted)
        return b.inputs, b.wanted


def keep_pixels(
    rendered: RenderResult,
    chosen: np.ndarray,
    target: Array,
    rows: Array,
    first: int,
    extent: float,
) -> None:
    """Write a row, from `first` on in rows (?, ROW), for each chosen pixel, (m,) uint32 indices
    into the padded image: its features, its direction, its place, and its residual (target - image)
    / alpha. target: (h, w, 3). extent: as for RenderResult.specular_arguments().
    """
    left, top = rendered.offset
    rendered.dev.program(KERNELS).launch(
        "specular_rows",
        len(chosen),
        m=len(chosen),
        first=first,
        target_width=target.shape[1],
        left=left,
        top=top,
        chosen=rendered.dev.upload(chosen),
        image=rendered.image,
        target=target,
        rows=rows,
        **rendered.specular_arguments(extent),
    )


def draw_batch(
    dev: Device, rows: Array, drawn: Array, unit: float, inputs: Array, wanted: Array
) -> None:
    """Write the inputs (?, ?, INPUTS) of a layer for n pixels, and the image (?, ?, 3) that it
    should give: 1/2 plus their residuals divided by `unit`. drawn: (n,) uint32, the rows of the
    pixels.
    """
    dev.program(KERNELS).launch(
        "specular_batch",
        len(drawn),
        n=len(drawn),
        unit=unit,
        drawn=drawn,
        rows=rows,
        inputs=inputs,
        wanted=wanted,
    )


def gradient_of_squares(dev: Device, image: Array, wanted: Array, gradient: Array) -> None:
    """Write the gradient (H, W, 3), by the image, of the mean square of image - wanted."""
    dev.program(KERNELS).launch(
        "specular_gradient",
        image.size,
        n=image.size,
        image=image,
        wanted=wanted,
        gradient=gradient,
    )


def _object_pixels(view, rendered):
    """(?,) uint32: indices into the padded image of the pixels that show the object and are not
    ignored.
    """
    alpha = 1 - rendered.dev.download(rendered.transmittance).reshape(rendered.size)
    is_used = np.zeros(rendered.size, bool)
    ignored = view.ignored_crop((0, 0, view.camera.width, view.camera.height))
    rendered.cropped(is_used)[:] = True if ignored is None else ~ignored
    return np.flatnonzero(is_used & (alpha >= LEAST_ALPHA)).astype(np.uint32)
