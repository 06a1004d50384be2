"""Checkpoints that no training made: whole ones for a run's settings, and broken ones."""

import json
import warnings
from unittest.mock import patch

import numpy as np
import pytest

from pp_cl.checkpoint import load_run_state, save_checkpoint
from pp_cl.config import preset
from pp_cl.engine.grid import Grid
from pp_cl.engine.stored import stored_table
from pp_cl.engine.training.exposure import decided_at
from pp_cl.errors import UserError
from pp_cl.scene.demo import demo_frames
from pp_cl.scene.identity import packed_camera
from pp_cl.selftest.points import some_ids

POINTS, STEP, STEPS = 40, 50, 60
HEADER = {
    "pixels": None,
    "views": [[frame.name, packed_camera(frame.camera)] for frame in demo_frames("train")[:3]],
    "step": STEP,
    "finished": False,
    "initial_points": 50,
    "grid": {"origin": [-1.0, -1.0, -1.0], "voxel_size": 0.25, "dims": [9, 8, 7]},
    "depth_range": [2.0, 6.0],
}


ONE = np.zeros(3, np.float32)


def ids(values):
    return np.array(values, np.uint32)


def settings(**changes):
    """The settings of such a run. changes: settings of the section train."""
    config = preset("tiny")
    config.scene.path = "demo"
    config.network.widths = (16, 16, 16)
    for name, value in ({"iterations": STEPS} | changes).items():
        setattr(config.train, name, value)
    return config


def contents(config, step=STEP, n=POINTS):
    """(header, {name: array}) that a run could have after `step` steps."""
    rng = np.random.default_rng(5)
    finished = step == config.train.iterations
    views = len(HEADER["views"])
    gains = 0 if finished or step >= decided_at(0, views) else views
    table = stored_table(config, n, None if finished else step, gains=gains)
    arrays = {name: rng.random(shape).astype(dtype) for name, (shape, dtype) in table.items()}
    arrays["points.ids"] = some_ids(rng, Grid.of_header(HEADER["grid"]), n)
    for name in {"points.offset", "state.a.offset"} & arrays.keys():
        arrays[name] -= np.float32(0.5)
    if "state.last_step" in arrays:
        arrays["state.last_step"] = rng.integers(0, step + 1, n).astype(np.uint32)
    return HEADER | {"step": step, "finished": finished}, arrays


def load_checkpoint(path):
    """(header, {name: numpy array}) of a checkpoint of any run."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    return json.loads(arrays.pop("header").tobytes()), arrays


def write_run(folder, config, header, arrays):
    """Write a run's folder with settings and this checkpoint, whatever its numbers are."""
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.config.write_text(config.to_json())
    with patch("pp_cl.checkpoint._is_finite", lambda _: True):
        save_checkpoint(folder.checkpoint, header, arrays)


def header_text(**changes):
    """The header as bytes; a change may be JSON text that json.dumps would not write."""
    header = {"format": 1, **HEADER}
    fields = [f'"{k}": {changes.get(k) or json.dumps(v)}' for k, v in header.items()]
    return ("{" + ", ".join(fields) + "}").encode()


def refusal(folder, config):
    """The single error line with which the checkpoint is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserError) as caught:
            load_run_state(folder, config)
    line = str(caught.value)
    assert line.startswith(f"{folder.checkpoint}: ") and line.isprintable() and len(line) < 400
    return line
