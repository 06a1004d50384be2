"""Surfaces of a run's folder and of the user's cache: checkpoint, settings, log, measurements."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np

from pp_cl.config import Config, load_config, sections
from pp_cl.errors import UserError
from pp_cl.files.checkpoint import load_checkpoint
from pp_cl.files.run_folder import Log
from pp_cl.info import run_facts
from pp_cl.layers import tuning
from pp_cl.layers.choice import VARIANTS, ConvShape, load_policy
from pp_cl.layers.conv import Direction
from pp_cl.metrics import lpips_weights
from pp_cl.sweep.plan import Job
from pp_cl.sweep.result import finished_row, progress
from pp_cl.trained import load_run
from pp_cl.training.stored import load_run_state
from pp_cl.view.follow import LogFollower
from tools.fuzz.binary import archived, changed_bytes, changed_npz, npy
from tools.fuzz.files import changed_tree
from tools.fuzz.judge import Case, check, check_json, check_numbers
from tools.fuzz.templates import ball_views, set_words, stored_json
from tools.fuzz.values import changed_json, changed_text, dumps

CONFIG_KEYS = ("scene", "train", "points", "iterations", "path", "preset", "network", "extra")
HEADER_KEYS = ("tuning", "pixels", "grid", "step", "finished", "depth_range", "extra")
LOG_KEYS = ("step", "seconds", "psnr", "loss", "device", "finished", "points", "test_psnr")


def check_run_files(folder: Path) -> None:
    """Raise a Finding unless what a command wrote into a run's folder is whole and finite."""
    _, arrays = load_checkpoint(folder / "checkpoint.npz")
    for name, array in arrays.items():
        check(array.dtype.kind != "f" or np.isfinite(array).all(), f"NaN in {name} written")
    check_json(folder / "log.jsonl")
    for file in folder.rglob("metrics.json"):
        mean = check_json(file)["mean"]
        check_numbers(mean, file.name)
        check(-1 <= mean["ssim"] <= 1 and -10 <= mean["psnr"] <= 100, f"metrics {mean}")
    left = [path.name for path in folder.rglob(".*.tmp*")]
    check(not left, f"temporary files left: {left}")


def _write(case, file, data):
    """Write a damaged file; now and then something else stands in its place."""
    file.write_bytes(data)
    if case.rng.random() < 0.02:
        case.label = changed_tree(case.rng, file)


def checkpoint(case: Case) -> None:
    """A checkpoint with changed bytes, members or header; what is believed is rendered."""
    rng, world = case.rng, case.world
    run = world.copied_run(rng.choice([world.finished, world.unfinished]), case.folder)
    data = run.checkpoint.read_bytes()
    if rng.random() < 0.5:
        header, arrays = load_checkpoint(run.checkpoint)
        case.label, header = changed_json(rng, header, HEADER_KEYS)
        text = np.frombuffer(dumps(header), np.uint8)
        members = {"header": text, **arrays}.items()
        data = archived([(f"{name}.npy", npy(array)) for name, array in members])
    else:
        case.label, data = (changed_npz if rng.random() < 0.8 else changed_bytes)(rng, data)
    _write(case, run.checkpoint, data)
    config = load_config(run.config)
    state = case.read(lambda: load_run_state(run, config))
    if state is None:
        return
    _check_state(*state)
    if rng.random() < 0.2:
        image = case.read(lambda: _rendered(world.device, run.path))
        check(image is None or np.isfinite(image).all(), "a rendering with NaN")
    if rng.random() < 0.05 and case.command("eval", run) == 0:
        check_run_files(run.path)
    again = "train", world.scenes["transforms"], "--out", run, *set_words()
    if rng.random() < 0.05 and case.command(*again) == 0:
        check_run_files(run.path)


def _check_state(header, arrays):
    grid, (near, far) = header["grid"], header["depth_range"]
    ids, opacity = arrays["points.ids"].astype(np.int64), arrays["points.opacity"]
    check((np.diff(ids) > 0).all() and ids[-1] < math.prod(grid["dims"]), "ids out of order")
    check(opacity.min() >= 0 and opacity.max() <= 1, "opacities that are none")
    check(0 <= near < far < math.inf and 0 < grid["edge"] < math.inf, "lengths that are none")
    check(len(ids) == len(opacity) > 0, "points without opacity")
    for name, array in arrays.items():
        check(array.dtype.kind != "f" or np.isfinite(array).all(), f"NaN in {name}")


def _rendered(device, folder):
    return load_run(device, folder).render(ball_views()["test"][0].stored_camera).colour


def config(case: Case) -> None:
    """A config.json; what is believed must be of the settings' types and within their limits."""
    rng = case.rng
    run = case.world.copied_run(case.world.finished, case.folder)
    data = run.config.read_bytes()
    if rng.random() < 0.75:
        case.label, value = changed_json(rng, json.loads(data), CONFIG_KEYS)
        data = dumps(value)
    else:
        case.label, data = (changed_text if rng.random() < 0.6 else changed_bytes)(rng, data)
    _write(case, run.config, data)
    read = case.read(lambda: load_config(run.config))
    if read is not None:
        check_config(read)
        _tell(case, run)


def _tell(case, run):
    """What `pp-cl info --json` says of the run, in which NaN would be a ValueError."""
    json.dumps(case.read(lambda: run_facts(run)), allow_nan=False)


def check_config(config: Config) -> None:
    """Raise a Finding unless settings are of their types and within their limits."""
    json.loads(config.to_json(), parse_constant=lambda name: check(False, f"{name} in settings"))
    for section, values in sections(config):
        for item in dataclasses.fields(values):
            value, key = getattr(values, item.name), f"{section}.{item.name}"
            several = isinstance(item.default, tuple)
            check(type(value) is type(item.default), f"{key} = {value!r}")
            check(not several or len(value) == len(item.default), f"{key} = {value!r}")
            least, most = item.metadata["least"], item.metadata["most"]
            for one in value if several else (value,):
                check(least is None or least <= one <= most, f"{key} = {one!r}")
            choices = item.metadata["choices"]
            check(not choices or value in choices, f"{key} = {value!r}")


def log(case: Case) -> None:
    """A log.jsonl, read by the resumption, by info, view and sweep."""
    rng, world = case.rng, case.world
    run = world.copied_run(rng.choice([world.finished, world.unfinished]), case.folder)
    data = run.log.read_bytes()
    if rng.random() < 0.6:
        lines = data.splitlines()
        at = rng.randrange(len(lines))
        case.label, row = changed_json(rng, json.loads(lines[at]), LOG_KEYS)
        lines[at] = dumps(row)
        data = b"\n".join(lines) + b"\n"
    else:
        case.label, data = (changed_text if rng.random() < 0.5 else changed_bytes)(rng, data)
    _write(case, run.log, data)
    rows = case.read(run.rows) or []
    for row in rows:
        check_numbers({name: row[name] for name in ("step", "seconds")}, "log")
    follower = LogFollower(run.log)
    follower.poll()
    check(all(math.isfinite(x) for row in follower.rows for x in row), "NaN in a curve")
    case.read(lambda: progress(_job(world, run)))
    _tell(case, run)
    kept = case.read(lambda: _cut_off(run.log, rng.choice([0, 2, 4])))
    if kept is not None:
        check(math.isfinite(kept) and kept >= 0, f"{kept} seconds")
        check_json(run.log)


def _cut_off(file, step):
    with Log(file, step) as kept:
        return kept.seconds


def _job(world, run):
    scene, given = str(world.config.scene.path), []
    return Job(scene, "ball", (), 0, str(run.path), "tiny", tuple(given), ("psnr", "ssim"), 4)


def metrics(case: Case) -> None:
    """The metrics.json of an evaluation, read by info and by a sweep that goes on."""
    rng, world = case.rng, case.world
    run = world.copied_run(world.finished, case.folder)
    file = run.evaluation("test") / "metrics.json"
    if rng.random() < 0.7:
        case.label, value = changed_json(rng, stored_json(file), ("mean", "psnr", "step"))
        data = dumps(value)
    else:
        case.label, data = (changed_text if rng.random() < 0.5 else changed_bytes)(
            rng, file.read_bytes()
        )
    _write(case, file, data)
    _tell(case, run)
    words = set_words()[1::2]
    pairs = [(key, text, "--set") for key, _, text in (word.partition("=") for word in words)]
    job = dataclasses.replace(_job(world, run), given=tuple(pairs))
    row = case.read(lambda: finished_row(job))
    if row:
        json.dumps(row, allow_nan=False)
        check_numbers({name: row[name] for name in ("psnr", "ssim", "points")}, "row")
        check(isinstance(row["device"], str), f"device {row['device']!r}")


# --------------------------------------------------------------------------------------------------


def tunings(case: Case) -> None:
    """The stored measurements of the device: what is broken is left aside with a warning."""
    rng, device = case.rng, case.world.device
    ms, errors = {"direct": 3.0, "winograd2": 1.0}, {"direct": 2e-7, "winograd2": 1e-7}
    rows = [
        {
            "direction": d.value,
            "k": 3,
            "ci": 16,
            "co": 16,
            "pixels": 4096,
            "ms": ms,
            "rel_l2": errors,
        }
        for d in Direction
    ]
    value = {"format": 1, "device": tuning.device_key(device), "tile_shapes": {}, "rows": rows}
    if rng.random() < 0.8:
        case.label, value = changed_json(rng, value, ("ms", "rel_l2", "k", "rows", "direct"))
        data = dumps(value)
    else:
        case.label, data = (changed_text if rng.random() < 0.5 else changed_bytes)(
            rng, json.dumps(value, indent=1).encode()
        )
    file = tuning.tuning_file(device)
    _write(case, file, data)
    try:
        policy = case.read(lambda: load_policy(device, rng.choice([1e-5, 1e-3])))
        shape = ConvShape(rng.choice(list(Direction)), 3, (16,), 16, rng.choice([1, 4096, 2**20]))
        chosen = case.read(lambda: policy.choose(shape))
        kind = "CPU" if device.is_cpu else "GPU"
        offered = [name for name, v in VARIANTS.items() if kind in v.devices and not v.half]
        check(chosen in (None, *offered), f"the variant {chosen!r}")
    finally:
        shutil.rmtree(file) if file.is_dir() else file.unlink(missing_ok=True)


def lpips(case: Case) -> None:
    """The cached weights of LPIPS: nothing but the very weights is ever taken."""
    rng, file = case.rng, case.world.cache / lpips_weights.WEIGHTS_FILE
    names = [f"kernel{i}" for i in range(3)] + [f"bias{i}" for i in range(3)] + ["head0"]
    data = archived([(f"{name}.npy", npy(np.ones((4, 4), np.float32))) for name in names])
    case.label, data = (changed_npz if rng.random() < 0.7 else changed_bytes)(rng, data)
    _write(case, file, data)
    fetched = lpips_weights.download

    def no_network():
        raise UserError("LPIPS weights: no network here")

    lpips_weights.download = no_network
    try:
        check(case.read(lpips_weights.load_weights) is None, "weights that are not LPIPS's")
    finally:
        lpips_weights.download = fetched
        shutil.rmtree(file) if file.is_dir() else file.unlink(missing_ok=True)


SURFACES = {
    "checkpoint": checkpoint,
    "config": config,
    "log": log,
    "metrics": metrics,
    "tuning": tunings,
    "lpips": lpips,
}
