"""Files out of joint, by their kind, and what may stand in their place."""

import gzip
import json
import os
from pathlib import Path
from random import Random

from tools.fuzz.binary import changed_bytes, changed_npy, changed_npz, changed_png
from tools.fuzz.values import changed_json, changed_text, dumps

# keys that frames and files may have beside those of the templates
KEYS = (
    *("fl_x", "fl_y", "cx", "cy", "w", "h", "near", "far", "camera_angle_x", "camera_angle_y"),
    *("k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "mask_path", "file_path", "frames"),
    *("train_filenames", "test_filenames", "applied_transform", "aabb_scale", "path", "size"),
    *("intrinsics_format", "mass", "R", "T", "focal_length", "principal_point", "frame_number"),
    *("camera_path", "camera_to_world", "fov", "render_width", "render_height", "rotation"),
    *("position", "fx", "fy", "width", "height", "transform_matrix"),
)


def changed_file(rng: Random, file: Path) -> str:
    """Change a file of a scene by its kind; returns what was done."""
    data = file.read_bytes()
    kind = file.suffix
    if kind == ".json" and rng.random() < 0.8:
        label, value = changed_json(rng, json.loads(data), KEYS)
        data = dumps(value)
    elif kind == ".jgz" and rng.random() < 0.8:
        label, value = changed_json(rng, json.loads(gzip.decompress(data)), KEYS)
        data = gzip.compress(dumps(value), 1)
    elif kind in (".json", ".txt") and rng.random() < 0.8:
        label, data = changed_text(rng, data)
    elif kind == ".npy":
        label, data = changed_npy(rng, data)
    elif kind == ".npz":
        label, data = changed_npz(rng, data)
    elif kind == ".png" and rng.random() < 0.5:
        label, data = changed_png(rng, data)
    else:
        label, data = changed_bytes(rng, data)
    file.unlink()
    file.write_bytes(data)
    return f"{file.name}: {label}"


def changed_tree(rng: Random, file: Path) -> str:
    """Replace a file by something else than a file that is damaged; returns what was done."""
    kind = rng.choice(["gone", "empty", "folder", "dangling", "loop", "pipe", "renamed", "outside"])
    if kind == "renamed":
        file.rename(file.with_name(rng.choice(["x", "ä", "x.png", f"{file.stem}.PNG", ".hidden"])))
        return f"{file.name}: {kind}"
    file.unlink()
    if kind == "empty":
        file.touch()
    elif kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind != "gone":
        target = {"dangling": "nothing", "loop": file.name, "outside": "/etc/passwd"}[kind]
        file.symlink_to(target)
    return f"{file.name}: {kind}"
