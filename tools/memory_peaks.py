"""Compare the planned memory of trainings with the measured peaks of device and host.

    python tools/memory_peaks.py [--scene FOLDER] [--only NAME ...] [--memory GIB] [--json FILE]

Each training is a process of its own, a few steps long, as allocations do not change between
prunings. Refinements come early, so that none is left out. The rows `phone` and `photos` train on
300 and 60 photographs of 12 megapixels, which are made in a temporary folder (most of them links)
and removed. With --memory on a CPU, the device's memory is in the host's peak, not in its plan.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from pp_cl.config import run_config
from pp_cl.drivers import open_device
from pp_cl.engine.camera import Camera
from pp_cl.files.atomic import write_json
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.session.training import open_training

MIB = 2**20
PHONE, SHRUNK = (4000, 3000), 4  # pixels; factor by which the drawing is enlarged
PHOTOGRAPHS = {"phone": 300, "photos": 60}  # {training: number of photographs}
EARLY = {"train.iterations": 70, "train.eval_every": 0}  # the field is smoothed once
# {name: (preset, settings)}
TRAININGS = {
    "tiny": ("tiny", {}),
    "small": ("small", {}),
    # pruning is off, else the second refinement would be left out
    "full": ("full", {"points.count": 30_000, "train.prune_weight": 0}),
    "paper": ("paper", {"points.count": 1_500_000, "scene.downscale": 4, "train.iterations": 4}),
    "paper in full": ("paper", {"train.iterations": 3}),  # takes 12 GiB on lego
    "phone": ("tiny", {"scene.downscale": 8}),
    "photos": ("full", {"train.memory_gib": 4, "train.prune_weight": 0}),
}


def write_phone_scene(folder: Path, count: int) -> str:
    """Write a scene of `count` photographs of 12 megapixels of a ball with a mask. All cameras look
    at its centre from one distance and see the same circle, so a few image files are enough.
    """
    width, height = PHONE
    y, x = np.mgrid[: height // SHRUNK, : width // SHRUNK] + 0.5
    inside = np.hypot(x - x.mean(), y - y.mean()) < 0.4 * height / SHRUNK
    rng = np.random.default_rng(0)
    frames = []
    for i in range(count):
        path = folder / f"r_{i}.png"
        if i < 4:
            colour = rng.integers(0, 256, (*inside.shape, 3), np.uint8)
            small = Image.fromarray(np.dstack([colour, 255 * inside.astype(np.uint8)]))
            small.resize(PHONE, Image.Resampling.NEAREST).save(path, compress_level=1)
        else:
            os.link(folder / f"r_{i % 4}.png", path)
        turn, rise = 2.4 * i, -0.3 + 1.2 * i / count
        eye = 4 * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        camera = Camera.look_at(eye, (0, 0, 0), fx=1.2 * width, width=width, height=height)
        frames.append({"file_path": f"r_{i}.png", **frame_keys(camera)})
    (folder / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    return str(folder)


def peaks(name: str, scene: str, memory: float = 0.0) -> dict:
    """The row of one training, in MiB; the process must do nothing else."""
    preset, settings = TRAININGS[name]
    settings = EARLY | settings | ({"train.memory_gib": memory} if memory else {})
    given = [(*item, "--only") for item in settings.items()]
    with tempfile.TemporaryDirectory() as temporary:
        folder = RunFolder(Path(temporary) / "run")
        config = run_config(folder, scene, preset, given)
        dev = open_device()
        training = open_training(dev, folder, config, None)
        training.run()
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    need, host_need = training.memory_plan.need, training.memory_plan.host_bytes
    return {
        "name": name,
        "points": need.points,
        "device_plan": need.device / MIB,
        "device": dev.peak_bytes / MIB,
        "host_plan": host_need / MIB,
        "host": host / MIB,
        "device_ratio": need.device / dev.peak_bytes,
        "host_ratio": host_need / host,
        "given_up": training.hull.given_up if training.hull else "",
    }


def measured(name: str, scene: str, memory: float) -> dict:
    """peaks() in a new process; if `memory` is set, in the form for GPUs."""
    command = [sys.executable, __file__, "--child", name, "--scene", scene, "--memory", f"{memory}"]
    card = {"PP_FORM": "gpu", "PP_MAX_ALLOCATION": f"{256 * memory}"} if memory else {}
    done = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | card
    )
    return json.loads(done.stdout.splitlines()[-1])


def row(name: str, scene: str, memory: float) -> dict:
    """The row of a training by its name."""
    if name not in PHOTOGRAPHS:
        return measured(name, scene, memory)
    with tempfile.TemporaryDirectory() as folder:
        return measured(name, write_phone_scene(Path(folder), PHOTOGRAPHS[name]), memory)


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="demo", help="folder of a scene (demo)")
    parser.add_argument("--only", nargs="+", choices=TRAININGS, default=list(TRAININGS))
    parser.add_argument(
        "--memory",
        type=float,
        default=0.0,
        metavar="GIB",
        help="as on a GPU of so much memory, of which it allocates a quarter at once",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there too")
    parser.add_argument("--child", choices=TRAININGS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(peaks(options.child, options.scene, options.memory)))
        return
    rows = [row(name, options.scene, options.memory) for name in options.only]
    print(json.dumps(rows, indent=1))
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
