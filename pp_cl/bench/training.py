"""`pp-cl bench train`: times a training's last steps by stages, and the host's work for one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from pp_cl.engine.device.device import Device
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.step import Trainer
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.listing import scene_box
from pp_cl.scene.load import open_scene
from pp_cl.settings import Config

STEPS = 5  # timed each way, after one that builds the kernels


def host_cost(trainer: Trainer, steps: int) -> dict[str, Any]:
    """{"host_ms": the processor's time to enqueue a step, "launches"}, medians of some steps."""
    dev, ms, launches = trainer.dev, [], []
    for _ in range(steps):
        start, before = time.thread_time() - dev.waited, dev.launches
        trainer.train_step()
        ms.append((time.thread_time() - dev.waited - start) * 1e3)
        launches.append(dev.launches - before)
    return {"host_ms": float(np.median(ms)), "launches": int(np.median(launches))}


def bench_step(dev: Device, config: Config) -> Iterator[dict[str, Any]]:
    """One row of medians over the last steps of a training, whose points fill the scene's hull with
    opacities in [0.3, 1], as a trained model has them.
    """
    views = open_scene(dev, config, ("train",)).splits["train"]
    hull = build_grid(dev, views, config.points.count, scene_box(config))
    net, near_far = UNet.of_settings(dev, config.network), depth_range(views, hull)
    opacity = np.random.default_rng(0).uniform(0.3, 1, len(hull.ids))
    cloud = PointCloud.create(dev, hull.ids, config.points.sh_degree, opacity)
    model = Model(dev, hull.grid, near_far, cloud, net=net)
    trainer = Trainer(dev, config, model, views)
    trainer.step = max(0, config.train.iterations - 1 - 2 * STEPS)
    trainer.progress = trainer.step / config.train.iterations
    if trainer.exposure and not trainer.exposure.is_applied:
        trainer.exposure = None  # whether to apply it is decided by then
    trainer.renew_crops()
    trainer.train_step()
    host = host_cost(trainer, STEPS)
    with dev.timed_stages() as seconds:
        for _ in range(STEPS):
            trainer.train_step()
    stages = {
        name: float(np.median(values)) * 1e3
        for name, values in seconds.items()
        if len(values) >= STEPS  # stages that every step has
    }
    yield {
        "scene": config.scene.path,
        "points": cloud.count,
        "size": max(max(view.camera.width, view.camera.height) for view in views),
        "blend": config.raster.blend,
        "ms": sum(stages.values()),
        "stages_ms": stages,
        **host,
        "peak_device_bytes": dev.peak_bytes,
    }
