"""What the network saves where a run's views are background: share of the work, time, and
difference from the dense one.

    python tools/sparse_tiles.py RUN --downscale 1 --widths 128,256,512 --views 4 --json FILE

Each view's features go through the same network computing all tiles and only the planned ones
(pp_cl/network/tile_plan.py), in turn. The gradient of the image is the training loss's against
the photograph. Without --widths it is the run's own network.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from pp_cl.bench.timing import interleave
from pp_cl.bench.unet import make_network
from pp_cl.commands.options import add_widths, integer
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.layers.choice import make_policy
from pp_cl.layers.tiles import tiles_find, tiles_hit
from pp_cl.network.tile_plan import gradient_tiles
from pp_cl.render import Renderer
from pp_cl.run import load_run
from pp_cl.scene.target import Target
from pp_cl.scene.views import evenly
from pp_cl.train import WHITE
from pp_cl.training.loss import Loss


class Comparison:
    """A run's model, and the network that its views go through."""

    def __init__(self, dev, folder, split, *, downscale, widths):
        self.dev = dev
        run = load_run(dev, folder)
        scene = run.scene(split)
        self.config = run.config
        self.views = (scene.reduced(downscale) if downscale else scene).splits[split]
        self.net = make_network(dev, widths, make_policy(dev)) if widths else run.model.net
        self.renderer = Renderer(dev, run.model, self.config.raster)
        self.target = Target(dev)
        self.loss = Loss(dev, self.config.train.ssim_weight, self.config.train.smooth_l1)

    def row(self, view, runs):
        """A row of one view: size, computed fraction, times in ms, ratios, largest differences,
        over the dense result's largest value.
        """
        camera = view.camera
        view_raster = self.renderer.forward(camera, self.config.raster.gamma[1], until="features")
        x = view_raster.features
        target, _ = self.target.crop(view, (0, 0, camera.width, camera.height))

        def plan():
            found = tiles_find(self.dev, target, WHITE).get()
            differs = gradient_tiles(found, x.shape[:2], view_raster.offset)
            hit = tiles_hit(self.dev, view_raster.pairs.pixel_offset, x.shape[:2]).get()
            return self.net.plan_tiles(x.shape[:2], hit, differs)

        chosen = plan()
        # of the image that has equal tiles: those of a dense one differ by rounding, of which the
        # SSIM's gradient makes a thousand times more
        grad = self.loss.forward_backward(
            self.net.forward(x, False, chosen), target, *view_raster.offset
        )

        def results(tiles):
            image, grad_x = self.net.forward(x, True, tiles).get(), self.net.backward(grad).get()
            return [image, grad_x, *[g.get() for g in self.net.gradients.values()]]

        def runner(training, make_plan):
            def run():
                self.net.forward(x, training, make_plan())
                if training:
                    self.net.backward(grad)
                self.dev.finish()

            return run

        differences = [
            float(np.abs(a - b).max() / np.abs(a).max())
            for a, b in zip(results(None), results(chosen), strict=True)
        ]
        plans = {"dense": lambda: None, "sparse": plan}
        times = interleave(
            {
                (direction, name): runner(direction == "train", make_plan)
                for direction in ("forward", "train")
                for name, make_plan in plans.items()
            },
            runs,
        )
        ms = {key: float(np.median(values)) for key, values in times.items()}
        return {
            "view": view.name,
            "size": list(x.shape[:2]),
            "computed_fraction": float(chosen.computed_fraction) if chosen else 1.0,
            **{f"{direction}_{name}_ms": value for (direction, name), value in ms.items()},
            **{f"{d}_ratio": ms[d, "dense"] / ms[d, "sparse"] for d in ("forward", "train")},
            "image_difference": differences[0],
            "grad_features_difference": differences[1],
            "grad_parameters_difference": max(differences[2:]),
        }


def main(argv: list[str] | None = None) -> int:
    """Measure, print, write; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    add, count = parser.add_argument, integer(1, 10_000)
    add("run", metavar="RUN", help="the folder of a run")
    add("--split", default="test", metavar="S", help="of the scene (test)")
    add("--downscale", type=count, metavar="N", help="reduction of the photographs (the run's)")
    add_widths(parser, "another network of these widths, with random weights (the run's)")
    add("--views", type=count, default=4, metavar="N", help="views, evenly spread (4)")
    add("--runs", type=count, default=3, metavar="N", help="timed runs of each (3)")
    add("--device", metavar="D", help="as `pp-cl devices` prints them")
    add("--json", metavar="FILE", help="also write the result there")
    options = parser.parse_args(argv)
    try:
        dev, rows = open_device(options.device), []
        given = {"downscale": options.downscale, "widths": options.widths}
        comparison = Comparison(dev, Path(options.run), options.split, **given)
        for view in evenly(comparison.views, options.views):
            rows.append(comparison.row(view, options.runs))
            told = (f"{k} {v:.3g}" if type(v) is float else f"{k} {v}" for k, v in rows[-1].items())
            print("  ".join(told), flush=True)
        if options.json:
            about = {"device": dev.name, "platform": dev.info["platform"]}
            write_json(options.json, about | {"rows": rows})
    except UserError as error:
        print(f"sparse_tiles: {error}", file=sys.stderr)
        return 2
    names = ("computed_fraction", "forward_ratio", "train_ratio")
    computed, forward, train = (float(np.mean([row[name] for row in rows])) for name in names)
    print(
        f"{len(rows)} views: {computed:.0%} of the multiplications remain; forward {forward:.2f}"
        f" times as fast as dense, with backward {train:.2f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
