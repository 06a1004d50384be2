"""Renders the training views of a run, with what each point adds to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from pp_cl import Camera, Run, track
from pp_cl.engine import RenderResult

COLOURS = slice(3)  # of the 16 features that are blended here; that behind them is 0 in all points


@dataclass
class Observation:
    """A run's N points in a view of H x W pixels; gone once the next view is asked for. It is a
    linear map, the blend weights (HW, S) of the visible points, which blended() applies and
    gathered() transposes, both after look(blending=True) alone.
    """

    run: Run
    camera: Camera
    view: RenderResult

    def point_weights(self) -> np.ndarray:
        """(N,) float32: each point's blend weights, summed over the pixels."""
        dev, n = self.run.dev, self.run.model.cloud.count
        weights, seen = dev.zeros((n,)), dev.zeros((n,))
        self.run.renderer.record_weights(self.view, weights, seen)
        return weights.get()

    @cached_property
    def visible(self) -> np.ndarray:
        """(S,) indices of the visible points, ascending."""
        return self.view.weights.visible.get()

    def blended(self, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((HW, 3), (HW,)) float32: colours (S, 3) blended by the weights, and what the weights of
        a pixel leave of 1.
        """
        rows = np.zeros((len(colours), 16), np.float32)
        rows[:, COLOURS] = colours
        pixels = self.run.renderer.blend(self.view, rows).reshape(-1, 16)
        rest = pixels[:, 3]  # of the background, whose features are 1
        return pixels[:, COLOURS] - rest[:, None], rest

    def gathered(self, pixels: np.ndarray) -> np.ndarray:
        """(S, 3) float32: of each point, the sum over the pixels (HW, 3) times its weights."""
        features = np.zeros((self.camera.height, self.camera.width, 16), np.float32)
        features[..., COLOURS] = pixels.reshape(*features.shape[:2], 3)
        return self.run.renderer.gather(self.view, features)[:, COLOURS]


def observe(
    run: Run, cameras: list[Camera], text: str, *, blending: bool = False
) -> Iterator[Observation]:
    """What the points contribute to each camera's view, in turn; a progress bar with a text shows
    on a terminal.
    """
    seen = None
    for camera in progress(cameras, text):
        if seen:
            del seen.view  # else its arrays would stay beside the larger ones of this view
        seen = look(run, camera, blending=blending)
        yield seen


def progress(cameras: list[Camera], text: str) -> Iterable[Camera]:
    """The cameras, with a progress bar on a terminal."""
    return track(cameras, text, "view")


def look(run: Run, camera: Camera, *, blending: bool = False) -> Observation:
    """What the points contribute to a camera's view."""
    until: Literal["features", "weights"] = "features" if blending else "weights"
    view = run.renderer.forward(camera, run.gamma, until=until, training=blending)
    return Observation(run, camera, view)


def directions(positions: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 3) unit vectors from the camera's eye to positions (N, 3)."""
    towards = positions - camera.eye
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)
