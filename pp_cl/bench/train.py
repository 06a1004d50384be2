"""`pp-cl bench train`: the rasteriser and the update of a training step on a scene, without the
network: time by stage, share of the points that are shaded, device memory.

The points fill the scene's hull, with random opacities as a trained model has them; views are whole
images at the last gamma, their pairs cached, and dL/dfeatures is random.
"""

from __future__ import annotations

import numpy as np

from pp_cl.config import Config
from pp_cl.device.device import Device
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.open import open_scene, scene_box
from pp_cl.train import Trainer
from pp_cl.training.optimiser import Rates

STEP = 2000  # whose learning rates are taken; all SH degrees move
CACHE_BYTES = 2 << 30
WIDTHS = (16, 16, 16)  # of a network that is updated, but not run
FORWARD = ("project", "pairs", "weights", "shade", "blend")


def make_trainer(dev: Device, config: Config) -> Trainer:
    """Trainer on the scene's hull, with opacities in [0.3, 1] and a network of 16 channels."""
    views = open_scene(dev, config, ("train",)).splits["train"]
    hull = build_grid(dev, views, config.points.count, scene_box(config))
    near_far = depth_range(views, hull)
    net = UNet(dev, widths=WIDTHS)
    model = Model.create(
        dev, hull.grid, hull.ids, near_far, net=net, degree=config.points.sh_degree
    )
    opacity = np.random.default_rng(0).uniform(0.3, 1, model.cloud.count).astype(np.float32)
    model.cloud.opacity.set(opacity)
    return Trainer(dev, config, model, views)


def bench_train(dev: Device, config: Config, views: int, rounds: int) -> dict:
    """{"points", "pairs", "shaded", "size", "stages_ms", "forward_ms", "backward_ms",
    "peak_device_bytes"}; shaded: a share of the points, size: (height, width) of the padded view.

    views: evenly spread over the scene's. Times are medians over the views of all rounds;
    backward_ms includes the update.
    """
    trainer = make_trainer(dev, config)
    renderer, rates = trainer.renderer, Rates.at(STEP, config.network, config.train)
    renderer.cache.set_budget(CACHE_BYTES)
    grads, step = {}, 0
    with dev.timed_stages() as seconds:
        for round_ in range(rounds + 1):
            if round_ == 1:
                seconds.clear()  # the first round builds the programs and fills the cache
            for i in range(views):
                view = trainer.views[len(trainer.views) * i // views]
                result = renderer.rasterise(view.camera, config.raster.gamma[1], key=i)
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
                        shaded=result.shaded,
                        sh_eps=1e-10,
                    )
    stages = {name: float(np.median(values)) * 1e3 for name, values in seconds.items()}
    return {
        "points": trainer.model.cloud.count,
        "pairs": result.pairs.total,
        "shaded": result.shaded.size / trainer.model.cloud.count,
        "size": result.features.shape[:2],
        "stages_ms": stages,
        "forward_ms": sum(stages[name] for name in FORWARD),
        "backward_ms": stages["backward"] + stages["update"],
        "peak_device_bytes": dev.peak_bytes,
    }
