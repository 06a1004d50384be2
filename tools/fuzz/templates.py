"""What is damaged: scenes of a small ball in every format, runs of it, and the device."""

import json
import math
import os
import shutil
from functools import cached_property
from importlib import import_module
from pathlib import Path

import numpy as np

from pp_cl.cli import main
from pp_cl.config import Config, load_config
from pp_cl.device import discover
from pp_cl.device.device import Device
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.camera import Camera
from pp_cl.scene.views import View
from pp_cl.train import Trainer
from tools.convert_scene import dealt

SIDE, VIEWS, RADIUS, DISTANCE = 16, 5, 0.8, 4.0
STEPS = 4
# {surface: (module of tools/scene_formats, arguments of its write(), where the scene lies in it)}
FORMATS = {
    "transforms": ("nerf_synthetic", {}, ""),
    "nerfstudio": ("nerfstudio", {}, ""),
    "colmap": ("colmap", {"binary": True}, ""),
    "colmap_text": ("colmap", {"binary": False}, ""),
    "co3d": ("co3d", {"version": 2}, "object/sequence"),
    "co3d_1": ("co3d", {"version": 1}, "object/sequence"),
    "neus": ("neus", {}, ""),
    "nsvf": ("nsvf", {}, ""),
    "llff": ("llff", {}, ""),
}
# of trainings that take a moment
SETTINGS = {
    "train.iterations": STEPS,
    "points.count": 300,
    "network.widths": "16,16,16",
    "train.crop": 12,
    "train.prune_every": 2,
    "train.checkpoint_every": 2,
    "train.log_every": 1,
    "train.previews": 1,
    "train.final_prune_weight": 0.0,
    "scene.downscale": 1,
}


def set_words(**changes: object) -> list[str]:
    """--set words of a small training; `train__crop=8` sets train.crop."""
    values = SETTINGS | {key.replace("__", "."): value for key, value in changes.items()}
    return [word for key, value in values.items() for word in ("--set", f"{key}={value}")]


def ball_views() -> dict[str, list[View]]:
    """The splits of a ball at the origin, seen from around it; its outline is a circle."""
    focal = 1.4 * SIDE
    outline = focal * RADIUS / math.sqrt(DISTANCE**2 - RADIUS**2)
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    alpha = 255 * (x**2 + y**2 < outline**2)
    views = []
    for i in range(VIEWS):
        angle, height = 2 * math.pi * i / VIEWS, (0.2, 0.7)[i % 2]
        across = math.cos(height)
        eye = np.array([math.cos(angle) * across, math.sin(angle) * across, math.sin(height)])
        camera = Camera.look_at(DISTANCE * eye, (0, 0, 0), fx=focal, width=SIDE, height=SIDE)
        image = np.dstack([128 + 6 * x, 128 - 7 * y, np.full_like(x, 40 * i), alpha])
        views.append(View(f"r_{i}.png", camera, image.astype(np.uint8)))
    return dealt({"train": views})


class World:
    """Templates of inputs below a folder, and the one device that everything is run on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cache = folder / "cache"
        self.cache.mkdir(exist_ok=True)
        os.environ["PP_CACHE"] = str(self.cache)
        for name in ("PP_DEBUG", "PP_MAX_ALLOCATION"):
            os.environ.pop(name, None)

    @cached_property
    def device(self) -> Device:
        """Of PP_DEVICE, else the default one."""
        return discover.open_device()

    def share_device(self) -> None:
        """Let the command line work on `device`, whose programs are built, unless another is
        named.
        """
        opened = discover.open_device
        device = self.device

        def shared(choice=None):
            named = choice or os.environ.get("PP_DEVICE") or os.environ.get("PP_MAX_ALLOCATION")
            return opened(choice) if named else device

        for module in ("device.discover", "run", "trained"):
            import_module(f"pp_cl.{module}").open_device = shared

    @cached_property
    def scenes(self) -> dict[str, Path]:
        """{surface: folder of the files of a scene}, see FORMATS."""
        views, found = ball_views(), {}
        for name, (module, options, _) in FORMATS.items():
            found[name] = self.folder / name
            found[name].mkdir()
            import_module(f"tools.scene_formats.{module}").write(found[name], views, **options)
        return found

    def copied_scene(self, name: str, folder: Path) -> Path:
        """The scene below a copy of its files in the folder."""
        shutil.copytree(self.scenes[name], folder, dirs_exist_ok=True)
        return folder / FORMATS[name][2]

    @cached_property
    def finished(self) -> Path:
        """The folder of a run that is trained and evaluated."""
        out = self.folder / "finished"
        self._must("train", self.scenes["transforms"], "--out", out, *set_words())
        self._must("eval", out)
        return out

    @cached_property
    def unfinished(self) -> Path:
        """The folder of a run that was interrupted."""
        out, step = self.folder / "unfinished", Trainer.train_step

        def stopping(trainer):
            if trainer.step == STEPS - 1:
                raise KeyboardInterrupt
            return step(trainer)

        Trainer.train_step = stopping
        try:
            self._must("train", self.scenes["transforms"], "--out", out, *set_words(), status=130)
        finally:
            Trainer.train_step = step
        return out

    def copied_run(self, run: Path, folder: Path) -> RunFolder:
        """A copy of a run."""
        return RunFolder(shutil.copytree(run, folder / "run"))

    @cached_property
    def config(self) -> Config:
        """The settings of the runs."""
        return load_config(self.finished / "config.json")

    def _must(self, *words, status=0):
        found = main([str(word) for word in words])
        if found != status:
            raise RuntimeError(f"{' '.join(map(str, words))} ended with {found}")


def stored_json(file: Path) -> dict:
    """What a file of JSON holds."""
    return json.loads(file.read_text("utf-8"))
