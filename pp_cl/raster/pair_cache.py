"""The hits of views that never change, kept in device memory from step to step: positions do not
move, only opacities do.
"""

from pp_cl.raster.pairs import LASTING


class PairCache:
    """Builds Pairs, or takes them from what it keeps. Results are the same bits either way.

    What came first stays: views are drawn in turn, so that dropping the one used longest ago would
    always drop the next. budget: bytes of device memory. bytes: in use, of len(cache) views.
    """

    def __init__(self, dev, budget=0):
        self.dev = dev
        self.budget = budget
        self.clear()

    def __len__(self):
        return len(self._views)

    def clear(self):
        """Forget everything: the points are others now."""
        self._views, self.bytes = {}, 0

    def build(self, key, pairs, view, size, projection, point_radius):
        """pairs.build(view, size, projection, point_radius) of the view called `key`; None: of one
        that may change.

        Of one key, all but the opacities must be the same until clear().
        """
        if key in self._views:
            pairs.adopt(*self._views[key])
            return
        pairs.build(view, size, projection, point_radius)
        arrays = {name: getattr(pairs, name) for name in LASTING}
        needed = sum(array.nbytes for array in arrays.values())
        if key is None or self.bytes + needed > self.budget:
            return
        self.bytes += needed
        copies = {name: self.dev.empty(array.shape, array.dtype) for name, array in arrays.items()}
        for name, array in arrays.items():
            self.dev.copy(copies[name], array)
        self._views[key] = (pairs.total, copies)
