"""What a report of a fault needs: device, driver and versions; the results as a table and as
JSON.
"""

import os
import platform
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pyopencl

from pp_cl import __version__
from pp_cl.device.device import Device
from pp_cl.selftest.run import Row

COLUMNS = "{:40} {:>11} {:>9}  {}".format
HEAD = COLUMNS("case", "worst error", "bound", "pass")


def setup(dev: Device) -> dict[str, str]:
    """{what: its name or version} of the device and of what runs on it."""
    # pyopencl adds the variable's options to each build
    options = [*dev.build_options, os.environ.get("PYOPENCL_BUILD_OPTIONS", "")]
    units, gibibytes = dev.info["compute_units"], dev.info["memory_bytes"] / 2**30
    return {
        "pp-cl": __version__,
        "device": f"{dev.name} ({dev.info['type']}, {units} units, {gibibytes:.1f} GiB)",
        "platform": dev.info["platform"],
        "driver": dev.info["driver"],
        "OpenCL": dev.info["version"],
        "build options": " ".join(options).strip(),
        "system": platform.platform(),
        "Python": platform.python_version(),
        "pyopencl": pyopencl.VERSION_TEXT,
        "numpy": np.__version__,
    }


def line(row: Row) -> str:
    """A line of the table; below it, indented, the reason of a failure that has one."""
    numbers = ["-" if n is None else f"{n:.2g}" for n in (row.error, row.bound)]
    reason = f"\n    {row.reason}" if row.reason else ""
    return COLUMNS(row.case, *numbers, "yes" if row.passed else "NO") + reason


def as_json(dev: Device, rows: Iterable[Row]) -> dict[str, Any]:
    """{"setup", "passed", "seconds", "cases": [a Row's fields]}; errors that are not finite are
    null, as JSON has no number for them.
    """
    rows = [row if np.isfinite(row.error or 0) else replace(row, error=None) for row in rows]
    return {
        "setup": setup(dev),
        "passed": all(row.passed for row in rows),
        "seconds": sum(row.seconds for row in rows),
        "cases": [asdict(row) for row in rows],
    }
