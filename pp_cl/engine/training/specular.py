"""Fits the specular layer of a model (network/specular.py) once its training has ended: by squares,
to pixels of all views in any order. A step of the training sees one view, and its loss takes
reflections for outliers.
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
SIDE = 64  # of a batch, SIDE x SIDE pixels
ROW = 22  # floats of a pixel: features, direction, colours
MOST_VIEWS, MOST_ROWS = 128, 2**18  # views that are looked at, pixels that are kept of them
LEAST_ALPHA = 0.5  # of these
RATE = 5e-3  # first learning rate, which falls as a cosine to 0
STEPS = 500  # half as many for each fold: more fit single views
FOLDS = 3
LEAST_SCALE = 0.1  # of a layer that is kept


class Fitted(NamedTuple):
    """layer: None where it is not worth having. scale: by which its colours were multiplied.
    before, after: mean squares of what the pixels lack, without it and with it.
    """

    layer: Specular | None
    scale: float
    before: float
    after: float


def fit_table(dev: Device, pixels: int) -> Table:
    """The buffers of SpecularFit for views of so many pixels in all."""
    image, most = ((SIDE, SIDE, 3), np.float32), dev.info["max_allocation_bytes"] // (4 * ROW)
    return {
        "rows": ((min(MOST_ROWS, pixels, most), ROW), np.float32),
        "drawn": ((SIDE * SIDE,), np.uint32),
        "inputs": ((SIDE, SIDE, INPUTS), np.float32),
        "wanted": image,
        "gradient": image,
    }


class SpecularFit:
    """The pixels that a layer is fitted to, of each view about as many. renderer: of the model
    without a layer. target(i): (h, w, 3) float32 on the device, what the image of views[i] should
    be.
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
        self._table = fit_table(self.dev, sum(one.width * one.height for one in cameras))
        self._rows = self.dev.empty(*self._table.pop("rows"))
        most, rng = len(self._rows) // len(looked_at), np.random.default_rng(seed)
        counts: list[int] = []
        for i in looked_at:
            rendered = renderer.forward(views[i].camera, gamma)
            chosen = _object_pixels(views[i], rendered)
            if len(chosen) > most:
                chosen = np.sort(rng.choice(chosen, most, replace=False))
            if len(chosen):
                keep_pixels(rendered, chosen, target(i), self._rows, first=sum(counts))
            counts.append(len(chosen))
            del rendered  # else its arrays would stay beside the larger ones of the next view
        self._fold = np.repeat(np.arange(len(counts)) % FOLDS, counts)
        lacking = self.dev.download(self._rows[: sum(counts)])[:, -3:]
        self._before = float(np.mean(lacking**2, dtype=np.float64)) if len(lacking) else 0.0
        # a layer is fitted in units of this, so that Adam's steps suit what it has to learn
        self._unit = 2 * math.sqrt(self._before)

    def fitted(self) -> Fitted:
        """The layer, scaled by how much of it is right in views that it is not fitted to, as folds
        of the views tell.
        """
        every, sums = np.arange(len(self._fold), dtype=np.uint32), np.zeros(2)
        for fold in range(FOLDS):
            is_out = self._fold == fold
            if is_out.any() and not is_out.all():
                sums += self._products(self._trained(every[~is_out], STEPS // 2), every[is_out])
        scale = min(1.0, max(0.0, float(sums[0] / sums[1]))) if sums[1] > 0 else 0.0
        if scale < LEAST_SCALE:
            return Fitted(None, scale, self._before, self._before)
        layer = self._trained(every, STEPS)
        rp, pp = self._products(layer, every) / (3 * len(every))
        layer.scale(scale * self._unit)
        after = self._before - 2 * scale * rp + scale**2 * pp
        return Fitted(layer, scale, self._before, float(after))

    def _trained(self, rows, steps):
        """A layer that is fitted to these rows."""
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
        """(2,) float64: of what these rows lack, r, and what the layer gives them, p, the sums of
        r p and p p.
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
        """(inputs, wanted images) on the device of SIDE * SIDE rows."""
        b = self._buffers
        b.require(self._table)
        self.dev.send(b.drawn, rows)
        draw_batch(self.dev, self._rows, b.drawn, self._unit, b.inputs, b.wanted)
        return b.inputs, b.wanted


def keep_pixels(
    rendered: RenderResult, chosen: np.ndarray, target: Array, rows: Array, first: int
) -> None:
    """Write to the rows (?, ROW) from `first` on what there is at chosen pixels (m,) uint32 of an
    image, padded: its features, its direction, and what its colour in the target (h, w, 3) has
    beyond that in the image, over alpha.
    """
    left, top = rendered.offset
    rendered.dev.program(KERNELS).launch(
        "specular_rows",
        len(chosen),
        m=len(chosen),
        first=first,
        width=rendered.size[1],
        target_width=target.shape[1],
        left=left,
        top=top,
        side=float(rendered.supersampling),
        chosen=rendered.dev.upload(chosen),
        camera=rendered.points.camera_buffer,
        transmittance=rendered.transmittance,
        features=rendered.features,
        image=rendered.image,
        target=target,
        rows=rows,
    )


def draw_batch(
    dev: Device, rows: Array, drawn: Array, unit: float, inputs: Array, wanted: Array
) -> None:
    """Write the inputs (?, ?, INPUTS) of a layer of n pixels, and the images (?, ?, 3) that it
    should give: 1/2 and their colours over `unit`. drawn: (n,) uint32, their rows.
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
    """Write the gradient by an image (H, W, 3) of the mean square of image - wanted."""
    dev.program(KERNELS).launch(
        "specular_gradient",
        image.size,
        n=image.size,
        image=image,
        wanted=wanted,
        gradient=gradient,
    )


def _object_pixels(view, rendered):
    """(?,) uint32: the pixels of a view's image, padded, that show the object and are not
    ignored.
    """
    alpha = 1 - rendered.dev.download(rendered.transmittance).reshape(rendered.size)
    is_told = np.zeros(rendered.size, bool)
    ignored = view.ignored_crop((0, 0, view.camera.width, view.camera.height))
    rendered.cropped(is_told)[:] = True if ignored is None else ~ignored
    return np.flatnonzero(is_told & (alpha >= LEAST_ALPHA)).astype(np.uint32)
