"""A short training of the demo: what a step and a frame spend their time on, and how PSNR grows
with it.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.config import Config, assign, configure, preset
from pp_cl.device.device import Device
from pp_cl.files.image import to_8bit
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.run import Training, open_training

TRIED_STEPS = 4  # whose time says how many fit; the first builds the kernels and does not count
TIMED_STEPS = 6  # the last ones, by stage
LEAST_STEPS, MOST_STEPS = 20, 8000
MEASURED = 8  # times that PSNR is measured
TIMED_FRAMES = 5


def bench_training(dev: Device, seconds: float) -> dict[str, Any]:
    """{"scene", "preset", "steps", "curve": rows of {"step", "seconds", "psnr"}, "step_ms",
    "frame_ms": {stage: {"ms", "least", "most"}}} of a training of about so many seconds, those of
    the measurements aside.

    The stages of a step are those of the last ones, each waited for: without waiting they overlap.
    """
    trial = _training(dev, _config(LEAST_STEPS))
    trial.trainer.train_step()
    start = time.perf_counter()
    for _ in range(TRIED_STEPS):
        trial.trainer.train_step()
    each = (time.perf_counter() - start) / TRIED_STEPS
    steps = int(np.clip(seconds / each, LEAST_STEPS, MOST_STEPS))
    training = _training(dev, _config(steps))
    curve, step_ms = _train(dev, training, steps)
    return {
        "scene": "demo",
        "preset": "tiny",
        "steps": steps,
        "points": training.trainer.model.cloud.count,
        "curve": curve,
        "step_ms": step_ms,
        "frame_ms": _frame(dev, training),
    }


def _config(steps: int) -> Config:
    config = configure(preset("tiny"), "demo")
    assign(config, "train.iterations", steps, "bench")
    assign(config, "train.eval_every", steps, "bench")  # so that there are views to measure
    return config


def _training(dev, config) -> Training:
    """Nothing is written: the folder need not exist."""
    return open_training(dev, RunFolder(Path("bench")), config, None)


def _train(dev, training, steps):
    """(rows of the curve, time of the last steps by stage)."""
    trainer, curve, spent = training.trainer, [], 0.0
    due = {round(steps * (i + 1) / MEASURED) for i in range(MEASURED)}
    while trainer.step < steps - TIMED_STEPS:
        start = time.perf_counter()
        trainer.train_step()
        spent += time.perf_counter() - start
        if trainer.step in due:
            curve.append(_row(training, spent))
    start = time.perf_counter()
    with dev.timed_stages() as stages:
        while trainer.step < steps:
            trainer.train_step()
    trainer.finish()
    spent += time.perf_counter() - start
    curve.append(_row(training, spent))
    return curve, _spread(stages)


def _row(training, seconds):
    trainer = training.trainer
    found = [
        psnr(to_8bit(trainer.render(view)), to_8bit(trainer.target(view)))
        for view in training.measured
    ]
    return {"step": trainer.step, "seconds": seconds, "psnr": float(np.mean(found))}


def _frame(dev, training):
    """Time of frames by stage."""
    trainer, view = training.trainer, training.measured[0]
    with dev.timed_stages() as stages:
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
