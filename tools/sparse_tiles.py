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
from pp_cl.commands.options import add_widths
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.layers.choice import make_policy
from pp_cl.layers.tiles import tiles_find
from pp_cl.network.tile_plan import gradient_tiles
from pp_cl.render import Renderer
from pp_cl.run import load_run
from pp_cl.scene.target import Target
from pp_cl.training.loss import WHITE, Loss


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
        """A row of one view: size, computed fraction, times in ms, ratios, largest differences."""
        camera = view.camera
        view_raster = self.renderer.forward(camera, self.config.raster.gamma[1], until="features")
        x = view_raster.features
        self.target.load(view)
        target = self.target.crop((0, 0, camera.width, camera.height))

        def plan():
            found = tiles_find(self.dev, target, WHITE).get()
            differs = gradient_tiles(found, x.shape[:2], view_raster.offset)
            return self.net.plan_tiles(x.shape[:2], view_raster.tiles.get(), differs)

        chosen = plan()
        # of the image that has equal tiles: those of a dense one differ by rounding, of which the
        # SSIM's gradient makes a thousand times more
        image = self.net.forward(x, False, chosen)
        grad = self.loss.forward_backward(image, target, *view_raster.offset)
        results = [self._results(x, grad, tiles) for tiles in (None, chosen)]
        differences = [
            float(np.abs(a - b).max() / np.abs(a).max()) for a, b in zip(*results, strict=True)
        ]
        times = interleave(
            {
                (direction, name): self._runner(
                    x, grad if direction == "train" else None, make_plan
                )
                for direction in ("forward", "train")
                for name, make_plan in (("dense", None), ("sparse", plan))
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

    def _results(self, x, grad, plan):
        image = self.net.forward(x, True, plan).get()
        return [
            image,
            self.net.backward(grad).get(),
            *[g.get() for g in self.net.gradients.values()],
        ]

    def _runner(self, x, grad, make_plan):
        def run():
            self.net.forward(x, grad is not None, make_plan() if make_plan else None)
            if grad is not None:
                self.net.backward(grad)
            self.dev.finish()

        return run


def main(argv=None):
    """Measure, print, write; returns the exit status. Differences: the largest over the dense
    result's largest value.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", metavar="RUN", help="the folder of a run")
    parser.add_argument("--split", default="test", metavar="S", help="of the scene (test)")
    parser.add_argument(
        "--downscale", type=int, metavar="N", help="reduction of the photographs (the run's)"
    )
    add_widths(parser, "another network of these widths, with random weights (the run's)")
    parser.add_argument(
        "--views", type=int, default=4, metavar="N", help="views, evenly spread (4)"
    )
    parser.add_argument("--runs", type=int, default=3, metavar="N", help="timed runs of each (3)")
    parser.add_argument("--device", metavar="D", help="as `pp-cl devices` prints them")
    parser.add_argument("--json", metavar="FILE", help="also write the result there")
    options = parser.parse_args(argv)
    try:
        if min(options.views, options.runs, options.downscale or 1) < 1:
            raise UserError("--views, --runs, --downscale: must be at least 1")
        dev = open_device(options.device)
        comparison = Comparison(
            dev,
            Path(options.run),
            options.split,
            downscale=options.downscale,
            widths=options.widths,
        )
        number = min(options.views, len(comparison.views))
        rows = []
        for i in range(number):
            rows.append(
                comparison.row(comparison.views[len(comparison.views) * i // number], options.runs)
            )
            print(
                "  ".join(
                    f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}"
                    for k, v in rows[-1].items()
                ),
                flush=True,
            )
        if options.json:
            write_json(
                options.json, {"device": dev.name, "platform": dev.info["platform"], "rows": rows}
            )
    except UserError as error:
        print(f"sparse_tiles: {error}", file=sys.stderr)
        return 2
    mean = {
        k: float(np.mean([row[k] for row in rows]))
        for k in ("computed_fraction", "forward_ratio", "train_ratio")
    }
    print(
        f"{number} views: {mean['computed_fraction']:.0%} of the multiplications remain; forward"
        f" {mean['forward_ratio']:.2f} times as fast as dense, with backward"
        f" {mean['train_ratio']:.2f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
