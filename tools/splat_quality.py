"""Measure a run's splat by steps of fitting: python tools/splat_quality.py RUN --steps 100 250 500.

Each row: processor seconds over the number of processors, Gaussians, and PSNR of five test views,
drawn as viewers draw splats, in windows as large as the images and three times as large each way,
reduced to the images; how far outside the hull of the masks the splat shows something, seen from
below and above, where no photograph was taken, as a share of the object's size.
"""

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from pp_cl import Camera
from pp_cl.engine import FirstFeatures, Model, Renderer, Target, evenly
from pp_cl.errors import UserError
from pp_cl.files import to_8bit
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.run import Run, load
from pp_cl.scene import up_of
from pp_cl.scene.hull import hull_on, silhouette
from pp_studio.camera_path import level
from pp_studio.export import QUALITIES, QUICK
from pp_studio.export.gaussians import LEAST_OPAQUE, config_of, fit_gaussians

SIZES = 1, 3  # of the windows: multiples of the images' size
VIEWS = 5
# Directions from which beside_hull() looks: azimuth and elevation, degrees. Its images: pixels of a
# side, share of a side that the object fills, alpha from which on a pixel shows something.
DIRECTIONS = (0, -45), (120, -45), (240, -45), (60, -75), (0, 80)
SIDE, FILLED, VISIBLE = 400, 0.8, 0.1


def row(run: Run, steps: int, cell: float) -> dict:
    """Fit a splat; returns its measurements."""
    before = sum(os.times()[:2])
    cloud = fit_gaussians(run, steps, cell)
    seconds = (sum(os.times()[:2]) - before) / (os.cpu_count() or 1)
    model = Model(run.dev, run.model.grid, run.model.depth_range, cloud, net=FirstFeatures(run.dev))
    renderer, target = Renderer(run.dev, model, config_of(run, steps).raster), Target(run.dev)
    measured: dict[int, list[float]] = {size: [] for size in SIZES}
    for view in evenly(run.scene("test").splits["test"], VIEWS):
        truth, height, width = to_8bit(target.whole(view)), view.camera.height, view.camera.width
        for size, values in measured.items():
            large = renderer.render(view.camera.resized(size * width, size * height), run.gamma)
            small = large.reshape(height, size, width, size, 3).mean((1, 3))
            values.append(psnr(to_8bit(small), truth))
    return {
        "steps": steps,
        "cell": cell,
        "seconds": round(seconds, 1),
        "gaussians": int((cloud.opacity.get()[:, 0] > LEAST_OPAQUE).sum()),
        "psnr": {size: round(float(np.mean(values)), 2) for size, values in measured.items()},
        "beside": round(beside_hull(run, renderer), 4),
    }


def beside_hull(run: Run, renderer: Renderer) -> float:
    """The largest distance from the silhouette of the masks' hull at which an image from DIRECTIONS
    has an alpha above VISIBLE, as a share of the diameter of the run's points.
    """
    (centre, radius), cameras = run.ball, run.cameras("train")
    hull = hull_on(run.dev, run.scene("train").splits["train"], run.model.grid)
    up = up_of(cameras)
    ahead = level(cameras[0].eye - centre, up)
    away = float(np.median([np.linalg.norm(camera.eye - centre) for camera in cameras]))
    focal, farthest = FILLED * SIDE / 2 * away / radius, 0.0
    for azimuth, elevation in np.radians(DIRECTIONS):
        across = np.cos(azimuth) * ahead + np.sin(azimuth) * np.cross(up, ahead)
        eye = centre + away * (np.cos(elevation) * across + np.sin(elevation) * up)
        camera = Camera.look_at(eye, centre, up, fx=focal, width=SIDE, height=SIDE)
        image = renderer.forward(
            camera, run.gamma, until="weights", depth_range=run.depth_range(camera)
        )
        through = run.dev.download(image.transmittance).reshape(image.size)
        outside = distance_transform_edt(~silhouette(run.model.grid, hull, camera))
        beside = outside[image.cropped(through) < 1 - VISIBLE].max(initial=0)
        farthest = max(farthest, float(beside) / (FILLED * SIDE))
    return farthest


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
