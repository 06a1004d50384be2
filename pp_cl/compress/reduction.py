"""Reduces a trained model: fewer points, network channels or SH degrees, coefficients of 16 bits;
and writes the reduced model as a run.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.compress.channels import channel_weights, kept_channels, reduced_parameters
from pp_cl.config import Config
from pp_cl.export.observe import observe
from pp_cl.files.atomic import atomic_folder, write_json, write_text
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.psnr_ssim import Metrics
from pp_cl.model import Model
from pp_cl.network.layers import convolutions
from pp_cl.network.unet import UNet
from pp_cl.run import Run, render_views
from pp_cl.scene.camera import Camera
from pp_cl.scene.views import View

LARGEST_HALF = 65504.0
REPORT = "compress.json"


@dataclass(frozen=True)
class Reduction:
    """What is left of a model and how it is rendered.

    keep: share of the points, those that weigh most. half: the SH coefficients have 16 bits.
    channels: of the network only those go on that weigh this share of their layer's heaviest; 0:
    all. degree: of the SH. early_stop: of raster.
    """

    keep: float
    half: bool
    channels: float
    degree: int
    early_stop: float

    @classmethod
    def of(cls, run: Run) -> Reduction:
        """A run as it is."""
        return cls(
            keep=1.0,
            half=run.model.cloud.sh[0].dtype == np.float16,
            channels=0.0,
            degree=run.config.points.sh_degree,
            early_stop=run.config.raster.early_stop,
        )


@dataclass(frozen=True)
class Original:
    """A trained run that reduced ones are made of. weights: (N,) float32, how much each point
    contributes; see point_weights(). channel_weights: see channels.channel_weights().
    """

    run: Run
    weights: np.ndarray
    channel_weights: dict[str, np.ndarray]

    @classmethod
    def of(cls, run: Run) -> Original:
        """A run, seen from its training cameras."""
        cameras = run.cameras("train")
        return cls(run, point_weights(run, cameras), channel_weights(run, cameras))

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """{name: array} of its checkpoint."""
        return {name: rows.get() for name, rows in self.run.model.arrays().items()}

    def reduced_arrays(self, reduction: Reduction) -> dict[str, np.ndarray]:
        """{name: array} of the checkpoint of a reduced run."""
        kept, arrays = heaviest(self.weights, reduction.keep), {}
        for name, array in self.arrays.items():
            degree = name.removeprefix("points.sh") if name.startswith("points.sh") else None
            if degree and int(degree) > reduction.degree:
                continue
            array = array[kept] if name.startswith("points.") else array
            if degree and reduction.half:  # what is beyond the largest number becomes that
                array = np.clip(array, -LARGEST_HALF, LARGEST_HALF).astype(np.float16)
            arrays[name] = array
        layers = self.run.model.net.layers
        parameters = {n.removeprefix("net."): a for n, a in arrays.items() if n.startswith("net.")}
        reduced = reduced_parameters(layers, parameters, self._kept(reduction))
        return arrays | {f"net.{name}": array for name, array in reduced.items()}

    def _kept(self, reduction):
        """{layer: the channels that it keeps}."""
        return kept_channels(self.run.model.net.layers, self.channel_weights, reduction.channels)

    def reduced(self, reduction: Reduction) -> Run:
        """The reduced run, on the same device."""
        run, config = self.run, self.config(reduction)
        net = UNet.of_settings(run.dev, config.network)
        arrays = self.reduced_arrays(reduction)
        model = Model.load(run.dev, run.header, arrays, net, degree=reduction.degree)
        return replace(run, config=config, model=model)

    def config(self, reduction: Reduction) -> Config:
        """The settings of a reduced run."""
        config = copy.deepcopy(self.run.config)
        config.points.sh_degree = reduction.degree
        config.raster.early_stop = reduction.early_stop
        if reduction.channels > 0 and self.channel_weights:
            kept = self._kept(reduction)
            layers = convolutions(self.run.model.net.layers)[:-1]
            config.network.channels = ",".join(str(len(kept[layer.name])) for layer in layers)
        return config

    def write(self, reduction: Reduction, out: Path, report: dict[str, Any]) -> None:
        """Write a run folder that evaluates, renders and exports like any other, and the report."""
        with atomic_folder(out) as unfinished:
            folder = RunFolder(unfinished)
            write_text(folder.config, self.config(reduction).to_json() + "\n")
            folder.save(self.run.header, self.reduced_arrays(reduction))
            write_json(unfinished / REPORT, report)


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
