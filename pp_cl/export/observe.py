"""Renders the training views of a run, with the blend weights of each point in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from tqdm import tqdm

from pp_cl.files.picture import Picture
from pp_cl.raster.weights import listed_hits
from pp_cl.render import RenderResult
from pp_cl.run import Run
from pp_cl.scene.camera import Camera


@dataclass
class Observation:
    """A run's N points in a view of H x W pixels; gone once the next view is asked for."""

    run: Run
    camera: Camera
    view: RenderResult

    def picture(self) -> Picture:
        """The view as the run renders it."""
        return self.run.render(self.camera)

    def point_weights(self) -> np.ndarray:
        """(N,) float32: each point's blend weights, summed over the pixels."""
        dev, n = self.run.dev, self.run.model.cloud.count
        weights, seen = dev.zeros((n,)), dev.zeros((n,))
        self.run.renderer.record_weights(self.view, weights, seen)
        return weights.get()

    def blend_matrix(self) -> csr_array:
        """(HW, N) float32: the blend weight of each point in each pixel y*W + x."""
        pairs = self.view.pairs
        kept, point, weight = listed_hits(pairs, self.view.weights)
        offset = np.concatenate([[0], np.cumsum(kept)])[pairs.pixel_offset.get()]
        shape = pairs.pixels, pairs.points
        matrix = csr_array((weight, point.astype(np.int32), offset), shape=shape)
        pixels = np.arange(pairs.pixels).reshape(self.view.size)
        return matrix[self.view.cropped(pixels).ravel()]


def observe(run: Run, cameras: list[Camera], text: str) -> Iterator[Observation]:
    """What the points contribute to each camera's view, in turn; a progress bar with a text shows
    on a terminal.
    """
    seen = None
    for camera in tqdm(cameras, desc=text, unit="view", leave=False, disable=None):
        if seen:
            del seen.view  # else its arrays would stay beside the larger ones of this view
        seen = Observation(run, camera, run.renderer.forward(camera, run.gamma, until="weights"))
        yield seen


def directions(positions: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 3) unit vectors from the camera's eye to positions (N, 3)."""
    towards = positions - camera.eye
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)
