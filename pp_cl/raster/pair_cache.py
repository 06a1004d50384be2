"""Pairs of views that repeat exactly, kept on the device within a memory budget.

Between two steps that show the same whole view, points keep their places; only opacities, features
and the network change. So the pairs can be kept, and projecting and sorting be skipped.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields, replace

from pyopencl.array import Array

from pp_cl.device.device import Device
from pp_cl.raster.pairs import Pairs

ARRAYS = tuple(field.name for field in fields(Pairs) if field.name != "count")
BY_PAIR = ("pair_pixel", "pair_point_closeness", "pair_key")


class PairCache:
    """Copies of Pairs by view. Results are the same bits with and without it.

    The first views stay: views are drawn in turn, so evicting the least recently used one would
    always evict the next. budget: bytes of device memory. bytes: in use, by len(cache) views.
    """

    def __init__(self, dev: Device, budget: int = 0):
        self.dev = dev
        self.budget = budget
        self.clear()

    def __len__(self):
        return len(self._views)

    def set_budget(self, budget: int) -> None:
        """Allow the cache so many bytes; what it holds already stays."""
        self.budget = budget

    def clear(self) -> None:
        """Forget all views, because the points have changed."""
        self._views: dict[Hashable, Pairs] = {}
        self.bytes = 0

    def get(self, key: Hashable) -> Pairs | None:
        """The pairs of the view called `key`, None where they are not here.

        Until clear(), a key must stand for one camera, size and set of points.
        """
        return self._views.get(key)

    def keep(self, key: Hashable, pairs: Pairs) -> None:
        """Keep a copy of the pairs of the view called `key`, if the budget allows.

        key: None for a view that does not repeat.
        """
        rows = {name: getattr(pairs, name) for name in ARRAYS}
        rows |= {name: rows[name][: max(1, pairs.total)] for name in BY_PAIR}
        needed = sum(array.nbytes for array in rows.values())
        if key is None or key in self._views or self.bytes + needed > self.budget:
            return
        self.bytes += needed
        self._views[key] = replace(pairs, **{name: self._copy(rows[name]) for name in ARRAYS})

    def _copy(self, array: Array) -> Array:
        copy = self.dev.empty(array.shape, array.dtype)
        self.dev.copy(copy, array)
        return copy
