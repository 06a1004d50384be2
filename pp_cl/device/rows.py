"""Arrays of a device as the host reads them: piece by piece, since a second copy of a model may not
fit into memory.
"""

from collections.abc import Iterator

import numpy as np
from pyopencl.array import Array

from pp_cl.device.device import Device

PIECE_BYTES = 2**26


class DeviceRows:
    """Arrays (N, ...) of a device side by side, joined along their second axis. Fetched when asked
    for: they must not change before. shape, dtype: of the joined array.
    """

    def __init__(self, dev: Device, *parts: Array) -> None:
        self._dev, self._parts = dev, parts
        first = parts[0]
        joined = (sum(part.shape[1] for part in parts),) if len(parts) > 1 else first.shape[1:2]
        self.shape = (*first.shape[:1], *joined, *first.shape[2:])
        self.dtype = first.dtype

    @property
    def nbytes(self) -> int:
        """Bytes of the joined array."""
        return sum(part.nbytes for part in self._parts)

    def pieces(self) -> Iterator[np.ndarray]:
        """The rows in numpy arrays of at most PIECE_BYTES, or of one row."""
        count = self.shape[0]
        rows = max(1, PIECE_BYTES * count // max(1, self.nbytes))
        for start in range(0, count, rows):
            columns = [self._dev.download(part[start : start + rows]) for part in self._parts]
            yield np.concatenate(columns, 1) if len(columns) > 1 else columns[0]

    def get(self) -> np.ndarray:
        """The joined array."""
        return np.concatenate([*self.pieces()] or [np.empty(self.shape, self.dtype)])
