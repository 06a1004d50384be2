"""Counts and lists the fragments of a view, for people and tests: nothing that trains or renders
needs them.
"""

from dataclasses import dataclass

import numpy as np

from pp_cl.engine.device.device import Device
from pp_cl.engine.device.scan import exclusive_scan
from pp_cl.engine.raster.pairs import Pairs, launch_tiles
from pp_cl.engine.raster.project import ProjectedPoints
from pp_cl.engine.raster.weights import BlendWeights


@dataclass(frozen=True)
class Fragments:
    """The fragments of a view with HW pixels, of each pixel nearest first, numpy arrays.

    offset: (HW+1,) int64, pixel q, y*W + x, has fragments offset[q] to offset[q+1]. point: uint32.
    falloff: float32, d, of several samples the mean of those that the point covers. weight: float32
    blend weights, 0 if the fragment is dropped. shows: bool, False if it is dropped.
    """

    offset: np.ndarray
    point: np.ndarray
    falloff: np.ndarray
    weight: np.ndarray
    shows: np.ndarray

    @property
    def pixel(self) -> np.ndarray:
        """The pixel of each fragment."""
        return np.repeat(np.arange(len(self.offset) - 1), np.diff(self.offset))


def count_fragments(
    dev: Device, points: ProjectedPoints, pairs: Pairs, weights: BlendWeights
) -> tuple[np.ndarray, np.ndarray]:
    """Two (H, W) int64: the number of points that cover a sample of each pixel, and of those among
    them that are not dropped.
    """
    counts = _launch(dev, points, pairs, weights)
    found, shown = (dev.download(n).reshape(pairs.size).astype(np.int64) for n in counts)
    return found, shown


def list_fragments(
    dev: Device, points: ProjectedPoints, pairs: Pairs, weights: BlendWeights
) -> Fragments:
    """All fragments of a view."""
    counts, _ = _launch(dev, points, pairs, weights)
    offset = dev.empty(pairs.pixels + 1, np.uint32)
    exclusive_scan(dev, counts, offset)
    offsets = dev.download(offset).astype(np.int64)
    total = max(1, offsets[-1])
    point, shows = dev.empty(total, np.uint32), dev.empty(total, np.uint8)
    falloff, weight = dev.empty(total), dev.empty(total)
    _launch(
        dev,
        points,
        pairs,
        weights,
        pixel_offset=offset,
        fragment_point=point,
        fragment_falloff=falloff,
        fragment_weight=weight,
        fragment_shows=shows,
    )

    def found(array):
        return dev.download(array)[: offsets[-1]]

    return Fragments(offsets, found(point), found(falloff), found(weight), found(shows) != 0)


def _launch(dev, points, pairs, weights, **listed):
    """The numbers of fragments and of those that show, (HW,) uint32 both; writes the arrays
    `listed`, if there are any.
    """
    counts, shown = (dev.empty(pairs.pixels, np.uint32) for _ in range(2))
    names = "pixel_offset", "fragment_point", "fragment_falloff", "fragment_weight"
    arrays = dict.fromkeys((*names, "fragment_shows")) | listed
    launch_tiles(
        dev,
        "raster/fragments",
        "fragments_list",
        points,
        pairs,
        pair_key=pairs.pair_key,
        is_listed=int(bool(listed)),
        pixel_count=counts,
        pixel_shown=shown,
        **arrays,
        **weights.walk(),
    )
    return counts, shown
