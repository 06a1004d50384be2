"""Compare short trainings by this tree, bit for bit, with those by another tree.

They run on each OpenCL driver of this machine, with drivers and kernels in the forms for CPUs and
for GPUs.

    python -m tools.bits BASE [--driver WORDS] [--form cpu|gpu] [--settings NAMES]

BASE: a commit, or the folder of a checkout. Each setting yields a digest of the checkpoint in the
middle of the training and at its end, of the log without times, of config.json, and of a rendering.
Digests that differ are printed, and the exit status is then 1.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).parents[1]
STEPS, SIDE, STOP = 40, 64, 30  # steps; pixels of an image; the step at which a training is resumed
COMMON = {
    "train.iterations": STEPS,
    "train.log_every": 5,
    "train.crop": 48,
    "train.prune_every": 15,
    "train.specular": "off",
    "points.count": 1500,
    "network.widths": (16, 32, 32),
}
NEVER = {"train.refine_at": (1.0, 1.0)}
# {name: settings}; only the first has the shipped network, smoothing and a specular layer
SETTINGS = {
    "tiny": {
        "train.iterations": 70,  # the field is smoothed after 64
        "train.specular": "auto",
        "network.widths": (32, 64, 128),
    },
    # more than 2^16 pixels, so that background is skipped; the crop is smaller than the image
    "tiles": NEVER | {"train.crop": 260, "points.count": 3000},
    "softmax": NEVER
    | {
        "raster.blend": "softmax",
        "raster.footprint": "disc",
        "raster.radius": 0.05,
        "raster.max_tracked": 8,
        "raster.early_stop": 0.001,
        "network.blocks": "double",
        "train.mask_weight": 0.0,
        "train.distortion_weight": 0.0,
        "train.offset_rate": (0.0, 0.0),
    },
    "gated": NEVER | {"network.blocks": "gated", "network.residual": False},
    "exposure": NEVER | {"train.exposure": "on"},
    "ignored": NEVER | {"train.pixel_jitter": False},
    "refined": {"train.refine_at": (0.5, 1.0)},
    "supersampled": NEVER | {"train.supersampled": 1.0},
    "discs": NEVER | {"raster.footprint": "disc", "raster.radius": 0.05},
    "gaussians": NEVER,  # which are fitted to the run
}


def write_scenes(folder: Path) -> None:
    """Write the scenes of all settings and the masks of ignored pixels, always with this tree."""
    sys.path[:0] = [str(ROOT / "tests")]
    from support.scenes import write_ball_scene

    write_ball_scene(folder / "ball", size=SIDE)
    write_ball_scene(folder / "large", views=4, size=4 * SIDE + 32)
    mask = np.zeros((SIDE, SIDE), np.uint8)
    mask[:20, :40] = 255
    (folder / "masks").mkdir()
    for image in (folder / "ball" / "train").iterdir():
        Image.fromarray(mask).save(folder / "masks" / image.name)


def digest(*arrays) -> str:
    """Hex digest of bytes, or of arrays with their shapes and dtypes."""
    hasher = hashlib.sha256()
    for array in arrays:
        if isinstance(array, np.ndarray):
            hasher.update(f"{array.dtype}{array.shape}".encode())
        hasher.update(array if isinstance(array, bytes) else np.ascontiguousarray(array).tobytes())
    return hasher.hexdigest()[:16]


def log_rows(file: Path) -> bytes:
    """A run's log without times."""
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    return json.dumps([{k: v for k, v in row.items() if k != "seconds"} for row in rows]).encode()


def digests(name: str, scenes: Path, out: Path) -> dict[str, str]:
    """Train with a setting, by the pp_cl that is imported; returns {what: digest}."""
    from pp_cl.session.training import train_scene

    scene = str(scenes / ("large" if name == "tiles" else "ball"))
    settings = COMMON | SETTINGS[name]
    if name == "ignored":
        settings["scene.ignore"] = str(scenes / "masks")
    step = 0

    def on_step(at, row):
        nonlocal step
        step = at

    train_scene(scene, out, settings=settings, on_step=on_step, is_stopped=lambda: step == STOP)
    hashes = {"half": digest((out / "checkpoint.npz").read_bytes())}
    run = train_scene(scene, out, settings=settings)
    hashes["checkpoint"] = digest((out / "checkpoint.npz").read_bytes())
    hashes["log"] = digest(log_rows(out / "log.jsonl"))
    hashes["config"] = digest((out / "config.json").read_bytes())
    view = run.render(run.cameras("test")[0], features=True)
    shown = view.colour, view.alpha, view.depth, view.median_depth, view.features
    hashes["rendering"] = digest(*shown)
    if name == "gaussians":
        from pp_studio.export.gaussians import fit_gaussians

        cloud = fit_gaussians(run, STEPS, cell=0)
        arrays = [array.get() for array in (cloud.ids, cloud.offset, cloud.opacity, *cloud.sh)]
        hashes["fitted"] = digest(*arrays)
    return hashes


def of_tree(tree: Path, scenes: Path, names: list[str], driver: str, form: str) -> dict:
    """Run digests() of a tree in a new process; returns {setting: its digests}."""
    changed = {"PYTHONPATH": str(tree), "PP_DEVICE": driver, "PP_FORM": form.replace("cpu", "")}
    with tempfile.TemporaryDirectory() as out:
        words = [sys.executable, __file__, "--tree", str(tree), "--scenes", str(scenes)]
        words += ["--out", out, "--settings", *names]
        done = subprocess.run(
            words, env=os.environ | changed, cwd=out, stdout=subprocess.PIPE, check=True
        )
    return json.loads(done.stdout)


def compare(base: Path, drivers: list[str], forms: list[str], names: list[str]) -> int:
    """Print which digests differ between the trees; returns how many do."""
    differing = 0
    with tempfile.TemporaryDirectory() as folder:
        write_scenes(Path(folder))
        for driver in drivers:
            for form in forms:
                ours, theirs = (
                    of_tree(tree, Path(folder), names, driver, form) for tree in (ROOT, base)
                )
                for name in names:
                    both = ours[name], theirs[name]
                    differs = [what for what in both[0] if both[0][what] != both[1].get(what)]
                    differing += len(differs)
                    verdict = f"differs: {', '.join(differs)}" if differs else "same bits"
                    print(f"{driver}, {form}: {name:14s}{verdict}", flush=True)
    return differing


def main() -> int:
    """Compare, or print the digests of one tree; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("base", nargs="?", help="a commit, or the folder of a checkout")
    parser.add_argument("--driver", help="words of one driver's name (all)")
    parser.add_argument("--form", choices=("cpu", "gpu"), help="one of both (both)")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    for name in ("tree", "scenes", "out"):  # options of the processes that train
        parser.add_argument(f"--{name}", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.tree:
        import pp_cl

        if options.tree not in Path(pp_cl.__file__).parents:
            raise SystemExit(f"{pp_cl.__file__} is imported, which is not in {options.tree}")
        hashes = {n: digests(n, options.scenes, options.out / n) for n in options.settings}
        print(json.dumps(hashes))
        return 0
    if not options.base:
        parser.error("say what to compare with: a commit, or a folder")
    from pp_cl.drivers import list_devices

    works = [device.platform.name for _, device, problem in list_devices() if not problem]
    drivers = [name for name in works if (options.driver or "").lower() in name.lower()]
    if not drivers:  # else nothing would be compared, and nothing would differ
        parser.error(f"--driver {options.driver}: none of {', '.join(works)}")
    forms = [options.form] if options.form else ["cpu", "gpu"]
    if Path(options.base).is_dir():
        return min(1, compare(Path(options.base).resolve(), drivers, forms, options.settings))
    with tempfile.TemporaryDirectory() as folder:
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "-q", "--detach", folder, options.base], check=True)
        try:
            return min(1, compare(Path(folder), drivers, forms, options.settings))
        finally:
            subprocess.run([*git, "remove", "--force", folder], check=True)


if __name__ == "__main__":
    sys.exit(main())
