"""`pp-cl bench train`: the stages of a training's step on a scene, without the network."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pp_cl.config import Config
from pp_cl.device.device import Device
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.load import open_scene, scene_box
from pp_cl.train import Trainer
from pp_cl.training.schedule import GAMMA, Rates

STEP = 2000  # whose learning rates are taken; all SH degrees move
WIDTHS = (16, 16, 16)  # of the network, which is updated, but not run
VIEWS, ROUNDS = 3, 5  # of the scene, evenly spread; over them
FORWARD = ("project", "pairs", "weights", "shade", "blend")


def bench_step(
    dev: Device, config: Config, views: int = VIEWS, rounds: int = ROUNDS
) -> Iterator[dict[str, Any]]:
    """One row of the rasteriser and the update, with the keys of bench_raster() but for those of
    bytes, copy and errors; size: of the padded view's longer side.

    The points fill the scene's hull, with opacities in [0.3, 1], as a trained model has them; views
    are whole images at the last gamma, dL/dfeatures is random. views: evenly spread over the
    scene's. Times are medians over the views of all rounds; backward_ms includes the update.
    """
    scene_views = open_scene(dev, config, ("train",)).splits["train"]
    hull = build_grid(dev, scene_views, config.points.count, scene_box(config))
    net, near_far = UNet(dev, widths=WIDTHS), depth_range(scene_views, hull)
    model = Model.create(
        dev, hull.grid, hull.ids, near_far, net=net, degree=config.points.sh_degree
    )
    trainer: Any = Trainer(dev, config, model, scene_views)
    cloud, renderer = model.cloud, trainer.renderer
    opacity = np.random.default_rng(0).uniform(0.3, 1, cloud.count).astype(np.float32)
    cloud.opacity.set(opacity)
    rates, grads, step = Rates.at(STEP, config.network, config.train), {}, 0
    with dev.timed_stages() as seconds:
        for round_ in range(rounds + 1):
            if round_ == 1:
                seconds.clear()  # the first round builds the programs
            for i in range(views):
                view = trainer.views[len(trainer.views) * i // views]
                result = renderer.forward(view.camera, GAMMA[1], until="features", training=True)
                if i not in grads:
                    values = np.random.default_rng(i).normal(size=result.features.shape) * 1e-6
                    grads[i] = dev.upload(values, np.float32)
                gradients = renderer.backward_features(result, grads[i])
                step += 1
                with dev.stage("update"):
                    trainer.optimiser.update(
                        step,
                        rates,
                        gradients,
                        points=result.points,
                        shaded=result.weights.shaded,
                        sh_eps=1e-10,
                    )
    stages = {name: float(np.median(values)) * 1e3 for name, values in seconds.items()}
    yield {
        "scene": config.scene.path,
        "points": cloud.count,
        "size": max(result.size),
        "gamma": GAMMA[1],
        "blend": config.raster.blend,
        "pairs": result.pairs.total,
        "shaded": int(result.weights.shaded.size),
        "forward_ms": sum(stages[name] for name in FORWARD),
        "backward_ms": stages["backward"] + stages["update"],
        "stages_ms": stages,
        "peak_device_bytes": dev.peak_bytes,
    }
