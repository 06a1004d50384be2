"""One training step's rasteriser and update on a scene, without the network: time by stage, points
shaded, device memory.

    python tools/paper_scale.py .../lego --lazy

The points fill the scene's hull, with random opacities as a trained model has them; views are whole
images at gamma 0.01, their hits kept (docs/raster.md), the gradient of the features random. The
network is there, at widths of 16, but does not run.
"""

import argparse
import sys
import time

import numpy as np

from pp_cl.config import assign, preset
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.model import Model
from pp_cl.run import open_scene, with_depth_range
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.views import reduced_camera
from pp_cl.train import Trainer
from pp_cl.training.optimiser import Rates

STEP = 2000  # whose learning rates are taken; all SH degrees move
GIB = 2**30


def make_trainer(dev, config):
    """Trainer of the `paper` preset on the scene's hull, with opacities in [0.3, 1]."""
    views = open_scene(dev, config, ("train",)).splits["train"]
    hull = build_grid(dev, views, config.points.count)
    near_far = depth_range(views, hull)
    model = Model.create(
        dev,
        hull.grid,
        hull.ids,
        near_far,
        config.network.widths,
        config.train.seed,
        config.points.sh_degree,
    )
    model.points["opacity"].set(
        np.random.default_rng(0).uniform(0.3, 1, model.count).astype(np.float32)
    )
    return Trainer(dev, config, model, with_depth_range(views, near_far))


def measure(dev, config, views, rounds):
    """{"points", "shaded", "hits", stage: median ms, ..., "forward", "gradients", "update",
    "peak_bytes"}.
    """
    trainer = make_trainer(dev, config)
    renderer, rates = trainer.renderer, Rates.at(STEP, config.network, config.train)
    renderer.cache.budget = 2 * GIB
    times, grads, step = {}, {}, 0

    def timed(name, function, *arguments):
        start = time.perf_counter()
        result = function(*arguments)
        dev.finish()
        times.setdefault(name, []).append((time.perf_counter() - start) * 1e3)
        return result

    for round_ in range(rounds + 1):
        if round_ == 1:
            times.clear()  # the first round builds the programs and keeps the hits
        for i in range(views):
            view = trainer.views[len(trainer.views) * i // views]
            stages = renderer.stages(
                reduced_camera(view, config.scene.downscale), config.raster.gamma[1], key=i
            )
            for name, stage in stages.items():
                timed(name, stage)
            if i not in grads:
                grads[i] = dev.upload(
                    np.random.default_rng(i).normal(size=renderer.features.shape) * 1e-6, np.float32
                )
            gradients = timed("gradients", renderer.backward_features, grads[i])
            step += 1
            timed(
                "update",
                trainer.optimiser.update,
                step,
                rates,
                gradients,
                renderer.camera,
                1e-10,
                renderer.weights.kept,
            )
    medians = {name: float(np.median(ms)) for name, ms in times.items()}
    return {
        "points": trainer.model.count,
        "shaded": renderer.weights.kept.size / trainer.model.count,
        "hits": renderer.pairs.total,
        **medians,
        "forward": sum(ms for name, ms in medians.items() if name not in ("gradients", "update")),
        "peak_bytes": dev.peak_bytes,
    }


def main(argv=None):
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", metavar="SCENE", help="folder of a scene")
    parser.add_argument("--points", default="4e6", metavar="N", help="wanted points (4 million)")
    parser.add_argument("--downscale", default="1", metavar="K", help="reduce the images K times")
    parser.add_argument("--lazy", action="store_true", help="lazy Adam in place of dense")
    parser.add_argument("--views", type=int, default=3, metavar="N", help="evenly spread (3)")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="over all views (5)")
    parser.add_argument("--device", metavar="D", help="as `pp-cl devices` prints them")
    options = parser.parse_args(argv)
    try:
        if min(options.views, options.rounds) < 1:
            raise UserError("--views, --rounds: must be at least 1")
        config = preset("paper")
        for key, value in (
            ("scene.path", options.scene),
            ("scene.downscale", options.downscale),
            ("points.count", options.points),
            ("network.widths", "16,16,16"),
            ("train.lazy_adam", options.lazy),
        ):
            assign(config, key, value, "paper_scale")
        result = measure(open_device(options.device), config, options.views, options.rounds)
    except UserError as error:
        print(f"paper_scale: {error}", file=sys.stderr)
        return 2
    print(
        f"{result['points']} points, {result['hits']} hits in a view, {result['shaded']:.0%}"
        f" shaded, {result['peak_bytes'] / GIB:.2f} GiB at the peak"
    )
    print(
        "  ".join(
            f"{name} {ms:.1f} ms"
            for name, ms in result.items()
            if name not in ("points", "hits", "shaded", "peak_bytes")
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
