"""What steps of fitting buy a run's splat: python tools/splat_quality.py RUN --steps 100 250 500.

Each row: processor seconds over the number of processors, Gaussians, and PSNR of five test views,
drawn as viewers draw splats in windows as large as the images and three times as large each way,
reduced to the images.
"""

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np

from pp_cl.engine import FirstFeatures, Model, Renderer, Target, evenly
from pp_cl.errors import UserError
from pp_cl.files import to_8bit
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.run import Run, load
from pp_studio.export import QUALITIES, QUICK
from pp_studio.export.gaussians import LEAST_OPAQUE, config_of, fit_gaussians

SIZES = 1, 3  # of the windows, in those of the run's images
VIEWS = 5


def row(run: Run, steps: int, cell: float) -> dict:
    """The measurements of a splat."""
    before = sum(os.times()[:2])
    cloud = fit_gaussians(run, steps, cell)
    seconds = (sum(os.times()[:2]) - before) / (os.cpu_count() or 1)
    model = Model(run.dev, run.model.grid, run.model.depth_range, cloud, net=FirstFeatures(run.dev))
    renderer, target = Renderer(run.dev, model, config_of(run, steps).raster), Target(run.dev)
    measured: dict[int, list[float]] = {size: [] for size in SIZES}
    for view in evenly(run.scene("test").splits["test"], VIEWS):
        truth, height, width = to_8bit(target.whole(view)), view.camera.height, view.camera.width
        for size, found in measured.items():
            large = renderer.render(view.camera.resized(size * width, size * height), run.gamma)
            small = large.reshape(height, size, width, size, 3).mean((1, 3))
            found.append(psnr(to_8bit(small), truth))
    return {
        "steps": steps,
        "cell": cell,
        "seconds": round(seconds, 1),
        "gaussians": int((cloud.opacity.get()[:, 0] > LEAST_OPAQUE).sum()),
        "psnr": {size: round(float(np.mean(found)), 2) for size, found in measured.items()},
    }


def main() -> int:
    """Print the rows; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="folder of a run whose scene is there"
    )
    parser.add_argument("--steps", type=int, nargs="+", default=[QUALITIES[QUICK][0]])
    parser.add_argument("--cell", type=float, default=QUALITIES[QUICK][1], help="0: each point")
    parser.add_argument("--json", metavar="FILE", help="write them there too")
    options = parser.parse_args()
    rows = []
    try:
        for folder in options.runs:
            run = load(folder)
            for steps in options.steps:
                rows.append({"run": Path(folder).name} | row(run, steps, options.cell))
                print(json.dumps(rows[-1]), flush=True)
    except UserError as error:
        print(f"splat_quality: {error}", file=sys.stderr)
        return 2
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
