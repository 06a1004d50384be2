"""PP_DEBUG: the check of outputs after each kernel, and the table of times printed at the end."""

import os
import sys
from collections import defaultdict
from typing import Any

import numpy as np

from pp_cl.engine.device.kernel import Kernel
from pp_cl.errors import UserError


def debug_level() -> int:
    """PP_DEBUG (docs/devices.md). Raises UserError for another value."""
    text = os.environ.get("PP_DEBUG") or "0"
    if text not in ("0", "1", "2", "3"):
        raise UserError(f"PP_DEBUG={text}: must be 0, 1, 2 or 3")
    return int(text)


def check_outputs(kernel: Kernel, arguments: dict[str, Any]) -> None:
    """Raise FloatingPointError for the first NaN or Inf in an output of a finished kernel."""
    for p in kernel.parameters:
        array = arguments[p.name]
        if p.is_buffer and not p.const and p.dtype is np.float32 and array is not None:
            values = array.get()
            bad = np.flatnonzero(np.isnan(values) if p.may_be_infinite else ~np.isfinite(values))
            if bad.size:
                raise FloatingPointError(
                    f"{kernel.label}: {p.name} has {bad.size} NaN or Inf, first at {bad[0]}"
                )


def print_times(
    stages: dict[str, list[float]], kernels: dict[str, list[float]], *, by_file: bool
) -> None:
    """Print a table to stderr, longest first: passes, median and total time of stages and of
    kernels, or of their files. stages, kernels: {name: seconds of each pass}.
    """
    rows: dict[str, list[float]] = defaultdict(list)
    rows |= {f"stage {name}": seconds for name, seconds in stages.items()}
    for label, seconds in kernels.items():
        rows[label.partition(":")[0] if by_file else label] += seconds
    for label, seconds in sorted(rows.items(), key=lambda r: -sum(r[1])):
        median, total = np.median(seconds) * 1e3, sum(seconds)
        print(
            f"{label:40s} {len(seconds):7d} x {median:9.3f} ms, {total:9.3f} s in all",
            file=sys.stderr,
        )
