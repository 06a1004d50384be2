"""What a training spends its time on: a short one of the demo, and steps on a scene without the
network.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from pp_cl.config import Config, assign, configure, preset
from pp_cl.device.device import Device
from pp_cl.files.image import to_8bit
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.load import open_scene, scene_box
from pp_cl.train import Trainer
from pp_cl.training.schedule import GAMMA, Rates

TRIED_STEPS = 4  # whose time says how many fit; the first builds the kernels and does not count
TIMED_STEPS = 6  # the last ones, by stage
LEAST_STEPS, MOST_STEPS = 20, 8000
MEASURED, MEASURED_VIEWS = 8, 4  # times that PSNR is measured, on how many views
TIMED_FRAMES = 5

STEP = 2000  # whose learning rates bench_step takes; all SH degrees move
WIDTHS = (16, 16, 16)  # of its network, which is updated, but not run
VIEWS, ROUNDS = 3, 5  # of the scene, evenly spread; over them
FORWARD = ("project", "pairs", "weights", "shade", "blend")
STAGE = "{:16} {:>8} {:>8} {:>8} {:>8}".format


def bench_demo(dev: Device, seconds: float) -> dict[str, Any]:
    """{"scene", "preset", "steps", "points", "curve": rows of {"step", "seconds", "psnr"},
    "step_ms", "frame_ms": {stage: {"ms", "least", "most"}}} of a training of about so many seconds,
    those of the measurements aside.

    The stages of a step are those of the last ones, each waited for: without waiting they overlap.
    """
    config = configure(preset("tiny"), "demo")
    # its look at all training views takes longer than the steps
    assign(config, "train.final_prune_weight", 0.0, "bench")
    views, hull = _open(dev, config)
    measured = open_scene(dev, config, ("test",), most=MEASURED_VIEWS).splits["test"]

    def begin(steps):
        assign(config, "train.iterations", steps, "bench")
        net = UNet.of_settings(dev, config.network)
        return _trainer(dev, config, views, hull, net)

    trial = begin(LEAST_STEPS)
    trial.train_step()
    start = time.perf_counter()
    for _ in range(TRIED_STEPS):
        trial.train_step()
    each = (time.perf_counter() - start) / TRIED_STEPS
    trainer = begin(int(np.clip(seconds / each, LEAST_STEPS, MOST_STEPS)))
    curve, step_ms = _train(trainer, measured)
    return {
        "scene": "demo",
        "preset": "tiny",
        "steps": config.train.iterations,
        "points": trainer.model.cloud.count,
        "curve": curve,
        "step_ms": step_ms,
        "frame_ms": _frame(trainer, measured[0]),
    }


def training_lines(training: dict[str, Any]) -> list[str]:
    """The tables of bench_demo()."""
    lines = ["{:>6} {:>9} {:>7}".format("step", "seconds", "PSNR")]
    lines += [
        f"{row['step']:6d} {row['seconds']:9.1f} {row['psnr']:7.2f}" for row in training["curve"]
    ]
    lines.append(STAGE("stage, ms", "step", "least", "most", "frame"))
    for name, row in training["step_ms"].items():
        frame = training["frame_ms"].get(name)
        numbers = [f"{row[key]:.2f}" for key in ("ms", "least", "most")]
        lines.append(STAGE(name, *numbers, f"{frame['ms']:.2f}" if frame else ""))
    return lines


def bench_step(
    dev: Device, config: Config, views: int = VIEWS, rounds: int = ROUNDS
) -> dict[str, Any]:
    """{"points", "pairs", "shaded", "size", "stages_ms", "forward_ms", "backward_ms",
    "peak_device_bytes"} of the rasteriser and the update, without the network; shaded: a share of
    the points, size: (height, width) of the padded view.

    The points fill the scene's hull, with opacities in [0.3, 1], as a trained model has them; views
    are whole images at the last gamma, dL/dfeatures is random. views: evenly spread over the
    scene's. Times are medians over the views of all rounds; backward_ms includes the update.
    """
    scene_views, hull = _open(dev, config)
    trainer = _trainer(dev, config, scene_views, hull, UNet(dev, widths=WIDTHS))
    cloud, renderer = trainer.model.cloud, trainer.renderer
    opacity = np.random.default_rng(0).uniform(0.3, 1, cloud.count).astype(np.float32)
    cloud.opacity.set(opacity)
    rates, grads, step = Rates.at(STEP, config.network, config.train), {}, 0
    with dev.timed_stages() as seconds:
        for round_ in range(rounds + 1):
            if round_ == 1:
                seconds.clear()  # the first round builds the programs
            for i in range(views):
                view = trainer.views[len(trainer.views) * i // views]
                result = renderer.forward(view.camera, GAMMA[1], until="features")
                if i not in grads:
                    values = np.random.default_rng(i).normal(size=result.features.shape) * 1e-6
                    grads[i] = dev.upload(values, np.float32)
                *gradients, _ = renderer.backward_features(result, grads[i])
                step += 1
                with dev.stage("update"):
                    trainer.optimiser.update(
                        step,
                        rates,
                        *gradients,
                        points=result.points,
                        shaded=result.weights.shaded,
                        sh_eps=1e-10,
                    )
    stages = {name: row["ms"] for name, row in _spread(seconds).items()}
    return {
        "points": cloud.count,
        "pairs": result.pairs.total,
        "shaded": result.weights.shaded.size / cloud.count,
        "size": result.size,
        "stages_ms": stages,
        "forward_ms": sum(stages[name] for name in FORWARD),
        "backward_ms": stages["backward"] + stages["update"],
        "peak_device_bytes": dev.peak_bytes,
    }


def _open(dev, config):
    """The training views and the hull of a scene."""
    views = open_scene(dev, config, ("train",)).splits["train"]
    return views, build_grid(dev, views, config.points.count, scene_box(config))


def _trainer(dev, config, views, hull, net):
    """A training that begins."""
    model = Model.create(
        dev,
        hull.grid,
        hull.ids,
        depth_range(views, hull),
        net=net,
        degree=config.points.sh_degree,
        opacity=config.points.opacity,
    )
    return Trainer(dev, config, model, views)


def _train(trainer, measured):
    """(rows of the curve, time of the last steps by stage)."""
    steps, curve, spent = trainer.config.train.iterations, [], 0.0
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
