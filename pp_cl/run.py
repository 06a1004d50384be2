"""The folder of a run: starting, resuming, logging, previews and checkpoints around the training
loop.
"""

import hashlib
import json
import sys
import time
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import remove_leftovers, write_text
from pp_cl.files.checkpoint import load_checkpoint, save_checkpoint
from pp_cl.files.contact_sheet import write_comparison
from pp_cl.layers.policy import load_policy, policy_of_run
from pp_cl.model import Model
from pp_cl.scene.hull import build_grid, depth_range, spacing_pixels
from pp_cl.scene.load import load_scene
from pp_cl.scene.views import reduced_camera
from pp_cl.train import Trainer
from pp_cl.training.memory import memory_plan, print_plan, spare_memory

CHECKPOINT = "checkpoint.npz"
# of a run's checkpoint
HEADER = ("scene", "step", "finished", "initial_points", "grid", "depth_range")


def load_run(path):
    """(header, arrays) of a run's checkpoint. Raises UserError as load_checkpoint does, and for an
    incomplete header.
    """
    header, arrays = load_checkpoint(path)
    missing = [key for key in HEADER if key not in header]
    if missing:
        raise UserError(
            f"{path}: its header lacks {', '.join(missing)}; delete it to train anew, or restore a"
            " copy"
        )
    return header, arrays


def open_scene(dev, config, splits):
    """Scene of config.scene.path with the given splits; `demo` is rendered on the device."""
    if config.scene.path != "demo":
        return load_scene(config.scene.path, splits)
    from pp_cl.scene.demo import SPLITS, demo_scene

    unknown = set(splits) - set(SPLITS)
    if unknown:
        raise UserError(f"--split {', '.join(unknown)}: demo has {', '.join(SPLITS)}")
    return demo_scene(dev)


def fingerprint(views):
    """Hex digest of the views' names, cameras and sizes, by which a checkpoint knows its scene."""
    digest = hashlib.sha256()
    for view in views:
        camera = view.camera
        digest.update(f"{view.name} {camera.width}x{camera.height} ".encode())
        digest.update(
            np.round(
                np.append(camera.pose.ravel(), [camera.fx, camera.fy, camera.cx, camera.cy]), 6
            ).tobytes()
        )
    return digest.hexdigest()


def with_depth_range(views, near_far):
    """The views with one (near, far) in all their cameras."""
    near, far = near_far
    return [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]


def train_run(folder, config, device_choice):
    """Train into `folder`, from its last checkpoint where there is one.

    config: config.Config. Raises UserError for a scene, folder or checkpoint that does not fit; a
    start that fails writes nothing.
    """
    checkpoint = folder / CHECKPOINT
    _check_folder(folder)
    stored = load_run(checkpoint) if checkpoint.exists() else None
    if stored and stored[0]["finished"]:
        print(
            f"{folder} is finished ({stored[0]['step']} steps); `pp-cl eval {folder} --metrics`"
            " measures it"
        )
        return
    dev = open_device(device_choice)
    print(f"device: {dev.name} [{dev.info['platform']}]")
    tolerance = config.network.tolerance
    policy = (
        policy_of_run(dev, tolerance, stored[0].get("tuning"), checkpoint)
        if stored
        else load_policy(dev, tolerance)
    )
    print(policy.origin)
    scene = open_scene(dev, config, ("train",))
    trainer, info = (
        _resume(dev, config, scene, *stored, checkpoint, policy)
        if stored
        else _start(dev, config, scene, policy)
    )
    info["tuning"] = policy.tuning
    plan = memory_plan(dev, config, trainer.model, trainer.views)
    print_plan(plan, dev)
    trainer.renderer.cache.budget = spare_memory(plan, config.train.memory_gib)

    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    write_text(folder / "config.json", config.to_json() + "\n")
    _optimise(trainer, config, folder, info)


def _check_folder(folder):
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is not a folder; choose another --out")
    if (
        folder.is_dir()
        and not (folder / "config.json").exists()
        and any(p for p in folder.iterdir() if not p.name.startswith("."))
    ):
        raise UserError(
            f"{folder}: holds other files and no config.json; choose an empty or new folder for"
            " --out"
        )


def _start(dev, config, scene, policy):
    """(Trainer, info) of a run from its beginning."""
    views = scene.splits["train"]
    reduced_camera(views[0], config.scene.downscale)  # refuses a reduction that leaves too little
    start = time.perf_counter()
    hull = build_grid(dev, views, config.points.count)
    near_far = depth_range(views, hull)
    dims = "x".join(str(d) for d in hull.grid.dims)
    print(
        f"hull: {len(hull.ids)} points on a {dims} grid, edge {hull.grid.edge:.6g}"
        f" ({spacing_pixels(hull, views, config.scene.downscale):.2f} pixels), depth"
        f" {near_far[0]:.3f} to {near_far[1]:.3f} ({time.perf_counter() - start:.1f} s)"
    )
    model = Model.create(
        dev,
        hull.grid,
        hull.ids,
        near_far,
        config.network.widths,
        config.train.seed,
        config.points.sh_degree,
        policy,
    )
    return Trainer(dev, config, model, with_depth_range(views, near_far)), {
        "scene": fingerprint(views),
        "initial_points": len(hull.ids),
    }


def _resume(dev, config, scene, header, arrays, file, policy):
    """(Trainer, info) of a run that goes on."""
    views = scene.splits["train"]
    if header["scene"] != fingerprint(views):
        raise UserError(
            f"{file}: belongs to another scene than {config.scene.path}; use another --out"
        )
    widths, degree = config.network.widths, config.points.sh_degree
    model = Model.load(dev, header, arrays, widths, degree, file, policy=policy)
    trainer = Trainer(dev, config, model, with_depth_range(views, model.depth_range))
    try:
        trainer.restore(header["step"], arrays)
    except (KeyError, ValueError) as error:
        raise UserError(
            f"{file}: its training state is incomplete ({error}); delete it to train anew, or"
            " restore a copy"
        ) from None
    print(f"resuming at step {header['step']} with {model.count} points")
    return trainer, {key: header[key] for key in ("scene", "initial_points")}


def _optimise(trainer, config, folder, info):
    """The loop over steps, with its log, previews and checkpoints."""
    settings = config.train
    log, seconds = _open_log(folder / "log.jsonl", trainer.step)
    preview_every = (
        -(-settings.iterations // settings.previews)
        if settings.previews
        else settings.iterations + 1
    )
    bar = tqdm(
        total=settings.iterations,
        initial=trainer.step,
        unit="step",
        mininterval=1 if sys.stderr.isatty() else 30,
        file=sys.stderr,
    )
    with log, bar:
        while trainer.step < settings.iterations:
            start = time.perf_counter()
            terms = trainer.train_step()
            t = trainer.step
            last = t == settings.iterations
            seconds += time.perf_counter() - start
            bar.update()
            if t % settings.log_every == 0 or last:
                _log(
                    log,
                    {
                        "step": t,
                        "seconds": round(seconds, 3),
                        **terms,
                        "points": trainer.model.count,
                        "rates": trainer.rates(),
                    },
                )
                bar.set_postfix(
                    psnr=f"{terms['psnr']:.2f}", points=trainer.model.count, refresh=False
                )
            if t % settings.checkpoint_every == 0 and not last:
                _save(trainer, folder, info, finished=False)
            if t % preview_every == 0 or last:
                _preview(trainer, folder, f"step_{t:06d}.png")
        start = time.perf_counter()
        trainer.finish()
        seconds += time.perf_counter() - start
        _save(trainer, folder, info, finished=True)
        _log(
            log,
            {
                "step": trainer.step,
                "seconds": round(seconds, 3),
                "points": trainer.model.count,
                "finished": True,
            },
        )
    print(
        f"trained {trainer.step} steps in {seconds:.1f} s; {trainer.model.count} of"
        f" {info['initial_points']} points remain; wrote {folder / CHECKPOINT}"
    )


def _open_log(path, step):
    """(file open for appending, training seconds so far): rows after `step` are cut off, they will
    be made again.
    """
    rows = []
    if path.exists():
        for line in path.read_text().splitlines():
            try:
                row = json.loads(line)
            except ValueError:
                break  # the line that a kill cut short
            if row["step"] > step or row.get("finished"):
                break
            rows.append(row)
    write_text(path, "".join(json.dumps(row) + "\n" for row in rows))
    return open(path, "a"), rows[-1]["seconds"] if rows else 0.0


def _log(file, row):
    try:
        file.write(json.dumps(row, allow_nan=False) + "\n")
        file.flush()
    except OSError as error:
        raise UserError(
            f"{file.name}: cannot be written ({error.strerror}); free some space, the same command"
            " goes on"
        ) from error


def _save(trainer, folder, info, finished):
    header = trainer.model.header() | info | {"step": trainer.step, "finished": finished}
    save_checkpoint(
        folder / CHECKPOINT, header, trainer.model.arrays() if finished else trainer.arrays()
    )


def _preview(trainer, folder, name):
    """Prediction, truth and error of the first training view."""
    (folder / "previews").mkdir(exist_ok=True)
    view = trainer.views[0]
    write_comparison(folder / "previews" / name, [trainer.picture(view)], [trainer.truth(view)])
