"""A short training of the demo: what a step and a frame spend their time on, and how PSNR grows
with it.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from pp_cl.config import Config, assign, configure, preset
from pp_cl.device.device import Device
from pp_cl.files.image import to_8bit
from pp_cl.layers.choice import load_policy
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.open import open_scene
from pp_cl.train import Trainer

TRIED_STEPS = 4  # whose time says how many fit; the first builds the kernels and does not count
TIMED_STEPS = 6  # the last ones, by stage
LEAST_STEPS, MOST_STEPS = 20, 8000
MEASURED, MEASURED_VIEWS = 8, 4  # times that PSNR is measured, on how many views
TIMED_FRAMES = 5


def bench_training(dev: Device, seconds: float) -> dict[str, Any]:
    """{"scene", "preset", "steps", "points", "curve": rows of {"step", "seconds", "psnr"},
    "step_ms", "frame_ms": {stage: {"ms", "least", "most"}}, "counts": of estimate.Counts, means of
    a few steps} of a training of about so many seconds, those of the measurements aside.

    The stages of a step are those of the last ones, each waited for: without waiting they overlap.
    """
    demo = _Demo(dev)
    trial = demo.trainer(LEAST_STEPS)
    trial.train_step()
    start = time.perf_counter()
    for _ in range(TRIED_STEPS):
        trial.train_step()
    each = (time.perf_counter() - start) / TRIED_STEPS
    trainer = demo.trainer(int(np.clip(seconds / each, LEAST_STEPS, MOST_STEPS)))
    steps = trainer.config.iterations
    curve, step_ms = _train(trainer, demo.measured)
    return {
        "scene": "demo",
        "preset": "tiny",
        "steps": steps,
        "points": trainer.model.cloud.count,
        "curve": curve,
        "step_ms": step_ms,
        "counts": _counts(trainer),
        "frame_ms": _frame(trainer, demo.measured[0]),
    }


class _Demo:
    """The demo and its hull. measured: a few test views."""

    def __init__(self, dev: Device):
        self._dev = dev
        config = self._config(LEAST_STEPS)
        self._views = open_scene(dev, config, ("train",)).splits["train"]
        self.measured = open_scene(dev, config, ("test",), most=MEASURED_VIEWS).splits["test"]
        self._hull = build_grid(dev, self._views, config.points.count)
        self._depth_range = depth_range(self._views, self._hull)

    def _config(self, steps) -> Config:
        config = configure(preset("tiny"), "demo")
        assign(config, "train.iterations", steps, "bench")
        # its look at all training views takes longer than the steps
        assign(config, "train.final_prune_weight", 0.0, "bench")
        return config

    def trainer(self, steps: int) -> Trainer:
        """A training of so many steps that begins."""
        config, hull = self._config(steps), self._hull
        policy = load_policy(self._dev, config.network.tolerance)
        model = Model.create(
            self._dev,
            hull.grid,
            hull.ids,
            self._depth_range,
            net=UNet.of_settings(self._dev, config.network, policy),
            opacity=config.points.opacity,
        )
        return Trainer(self._dev, config, model, self._views)


def _train(trainer, measured):
    """(rows of the curve, time of the last steps by stage)."""
    steps, curve, spent = trainer.config.iterations, [], 0.0
    due = {round(steps * (i + 1) / MEASURED) for i in range(MEASURED)}
    while trainer.step < steps - TIMED_STEPS:
        start = time.perf_counter()
        trainer.train_step()
        spent += time.perf_counter() - start
        if trainer.step in due:
            curve.append(_row(trainer, measured, spent))
    start = time.perf_counter()
    with trainer.dev.timed_stages() as stages:
        while trainer.step < steps:
            trainer.train_step()
    trainer.finish()
    spent += time.perf_counter() - start
    curve.append(_row(trainer, measured, spent))
    return curve, _spread(stages)


def _row(trainer, measured, seconds):
    found = [
        psnr(to_8bit(trainer.render(view)), to_8bit(trainer.target(view))) for view in measured
    ]
    return {"step": trainer.step, "seconds": seconds, "psnr": float(np.mean(found))}


def _counts(trainer):
    """What steps like the last ones work on."""
    pairs, shaded = [], []
    for i in range(TIMED_STEPS):
        index, box, jitter = trainer.draw(np.random.default_rng(i))
        camera = trainer.views[index].crop_camera(box, jitter)
        result = trainer.renderer.rasterise(camera, trainer.gamma[1])
        pairs.append(result.pairs.total)
        shaded.append(result.shaded.size)
    height, width, _ = result.features.shape
    return {
        "points": trainer.model.cloud.count,
        "pairs": round(np.mean(pairs)),
        "shaded": round(np.mean(shaded)),
        "height": height,
        "width": width,
    }


def _frame(trainer, view):
    """Time of frames by stage."""
    with trainer.dev.timed_stages() as stages:
        for i in range(TIMED_FRAMES + 1):
            if i == 1:
                stages.clear()  # buffers of this size have been made
            trainer.render(view)
    return _spread(stages)


def _spread(stages):
    """{stage: median, least and most milliseconds of its passes}."""
    return {
        name: {
            "ms": float(np.median(values)) * 1e3,
            "least": min(values) * 1e3,
            "most": max(values) * 1e3,
        }
        for name, values in stages.items()
    }
