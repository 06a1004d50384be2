"""Reduces a trained model: fewer points, coefficients of 16 bits; and writes the reduced model as a
run.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.export.length import FILE as LENGTH
from pp_cl.export.observe import observe
from pp_cl.files.atomic import atomic_folder, write_json, write_text
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.psnr_ssim import Metrics
from pp_cl.model import Model
from pp_cl.raster.points import PointCloud
from pp_cl.run import Run, render_views
from pp_cl.scene.camera import Camera
from pp_cl.scene.views import View

LARGEST_HALF = 65504.0
REPORT = "compress.json"


@dataclass(frozen=True)
class Original:
    """A trained run that reduced ones are made of."""

    run: Run

    @cached_property
    def weights(self) -> np.ndarray:
        """(N,) float32: point_weights() of its training cameras."""
        return point_weights(self.run, self.run.cameras("train"))

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """{name: array} of its checkpoint."""
        return {name: rows.get() for name, rows in self.run.model.arrays().items()}

    def reduced_arrays(self, keep: float, half: bool) -> dict[str, np.ndarray]:
        """{name: array} of the checkpoint of a reduced run. keep: share of the points, those that
        weigh most. half: the SH coefficients have 16 bits.
        """
        kept, arrays = heaviest(self.weights, keep), dict(self.arrays)
        for name, array in self.arrays.items():
            if name.startswith("points."):
                arrays[name] = array[kept]
            if name.startswith("points.sh") and half:
                # what is beyond the largest number becomes that
                clipped = np.clip(arrays[name], -LARGEST_HALF, LARGEST_HALF)
                arrays[name] = clipped.astype(np.float16)
        return arrays

    def reduced(self, keep: float, half: bool) -> Run:
        """The reduced run, on the same device, with the same network."""
        run, old = self.run, self.run.model
        arrays = self.reduced_arrays(keep, half)
        cloud = PointCloud.load(run.dev, arrays, run.config.points.sh_degree)
        model = Model(run.dev, old.grid, old.depth_range, cloud, net=old.net)
        return replace(run, model=model)

    def write(self, keep: float, half: bool, out: Path, report: dict[str, Any]) -> None:
        """Write a run folder that evaluates, renders and exports like any other, and the report."""
        with atomic_folder(out) as unfinished:
            folder = RunFolder(unfinished)
            write_text(folder.config, self.run.config.to_json() + "\n")
            folder.save(self.run.header, self.reduced_arrays(keep, half))
            write_json(unfinished / REPORT, report)
            known = self.run.folder.path / LENGTH
            if known.exists():
                shutil.copyfile(known, unfinished / LENGTH)


def point_weights(run: Run, cameras: list[Camera]) -> np.ndarray:
    """(N,) float32: the most that each point weighs in one of the cameras' views, as the sum of its
    blend weights over the pixels. What few views see counts as much as what many see.
    """
    most = np.zeros(run.model.cloud.count, np.float32)
    for seen in observe(run, cameras, "weighing points"):
        np.maximum(most, seen.point_weights(), out=most)
    return most


def heaviest(weights: np.ndarray, share: float) -> np.ndarray:
    """(M,) ascending: the indices of this share of the points, at least one, that weigh most; of
    equal ones the first.
    """
    count = max(1, round(share * len(weights)))
    return np.sort(np.argsort(-weights, kind="stable")[:count])


def nbytes(run: Run) -> int:
    """Bytes of the arrays of a run's checkpoint."""
    return sum(rows.nbytes for rows in run.model.arrays().values())


def measured_psnr(run: Run, views: Sequence[View]) -> float:
    """Mean PSNR of the run's 8-bit images of the views, in dB."""
    measure = Metrics(run.dev, ("psnr",))
    rows = [measure(seen.image, seen.truth)["psnr"] for seen in render_views(run, list(views))]
    return float(np.mean(rows))
