"""A rendered view on the host: its colour, alpha and depth, and its conversion to image files."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from pp_cl.files.image import to_8bit, write_png
from pp_cl.files.srgb import srgb_to_linear

WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class RenderedView:
    """A view of a model, as float32 arrays. colour: (H, W, 3), sRGB in [0, 1], over white. alpha:
    (H, W) in [0, 1]. depth, median_depth: (H, W), along the camera's axis in world units: the mean
    by blend weight, and the depth at which half the weight is reached; infinite where alpha is 0.
    features: (H, W, 16), the network's input, or None.
    """

    colour: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    median_depth: np.ndarray
    features: np.ndarray | None = None

    def over(self, background: tuple[float, float, float] | None) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]: the object over an sRGB colour; None: (H, W, 4) rgba()."""
        if background is None:
            return self.rgba()
        if tuple(background) == WHITE:
            return self.colour
        rgba = self.rgba()
        alpha = rgba[..., 3:]
        return rgba[..., :3] * alpha + (1 - alpha) * np.asarray(background, np.float32)

    def rgba(self) -> np.ndarray:
        """(H, W, 4) float32 in [0, 1]: straight (not premultiplied) colour, and alpha."""
        alpha = self.alpha[..., None]
        # a colour c of alpha a shows over white as a c + (1 - a)
        straight = (self.colour - (1 - alpha)) / np.maximum(alpha, 1 / 255)
        return np.concatenate([np.clip(straight, 0, 1), alpha], axis=2)

    def channels(self) -> dict[str, np.ndarray]:
        """{channel: (H, W) float32} for OpenEXR: R, G, B, in linear light and multiplied by alpha;
        A; Z, the median depth; mean.Z; feature.00 to feature.15 if the rendering has features.
        """
        rgba = self.rgba()
        light = srgb_to_linear(rgba[..., :3]) * rgba[..., 3:]
        channels = {name: light[..., i] for i, name in enumerate("RGB")}
        channels |= {"A": rgba[..., 3], "Z": self.median_depth, "mean.Z": self.depth}
        if self.features is not None:
            count = self.features.shape[2]
            channels |= {f"feature.{i:02d}": self.features[..., i] for i in range(count)}
        return {name: np.ascontiguousarray(array, np.float32) for name, array in channels.items()}

    def save(self, path: Path | str, background: tuple[float, float, float] | None = WHITE) -> None:
        """Write an 8-bit PNG; background None: transparent. Raises UserError like write_png()."""
        write_png(path, self.over(background))

    def _repr_png_(self) -> bytes:
        """A PNG of the rendering over white, which notebooks show."""
        encoded = io.BytesIO()
        Image.fromarray(to_8bit(self.colour)).save(encoded, "PNG")
        return encoded.getvalue()


def mean_rendered_view(views: Iterable[RenderedView]) -> RenderedView:
    """The mean of several samples of one view, with the depths and features of the first."""
    taken = iter(views)
    first, n = next(taken), 1
    colour, alpha = first.colour, first.alpha
    for sample in taken:
        colour, alpha, n = colour + sample.colour, alpha + sample.alpha, n + 1
        del sample  # before the next is taken
    colour, alpha = ((total / np.float64(n)).astype(np.float32) for total in (colour, alpha))
    return replace(first, colour=colour, alpha=alpha)
