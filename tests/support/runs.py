"""Trainings started, interrupted and resumed as a user does."""

import importlib
import os
import pkgutil
import sys

import pp_cl
from pp_cl.cli import main
from pp_cl.device.discover import open_device
from pp_cl.train import Trainer

# Every mechanism of the loop is due several times within 60 steps.
SETTINGS = {
    "train.iterations": 60,
    "points.count": 1500,
    "network.widths": "16,16,16",
    "train.crop": 24,
    "train.prune_every": 10,
    "train.checkpoint_every": 10,
    "train.log_every": 5,
    "train.previews": 2,
    "train.final_prune_weight": 0.5,
}


def arguments(scene, out, downscale=2, **changes):
    """Command line of a small training."""
    settings = SETTINGS | {k.replace("__", "."): v for k, v in changes.items()}
    sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    return ["train", scene, "--out", str(out), "--downscale", str(downscale), *sets]


def train_and_interrupt(scene, out, steps, monkeypatch, **changes):
    """A small training that ends with Ctrl-C after `steps` steps."""
    train_step, done = Trainer.train_step, []

    def stopping(self):
        if len(done) == steps:
            raise KeyboardInterrupt
        done.append(0)
        return train_step(self)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", stopping)
        assert main(arguments(scene, out, **changes)) == 130


def share_device(patch):
    """Let all commands work on one device, whose programs stay built, until a MonkeyPatch is
    undone, unless a command names one. Returns it.
    """
    for module in pkgutil.walk_packages(pp_cl.__path__, "pp_cl."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    device = open_device()

    def shared(choice=None):
        named = choice or os.environ.get("PP_DEVICE") or os.environ.get("PP_MAX_ALLOCATION")
        return open_device(choice) if named else device

    for name, module in list(sys.modules.items()):
        if name.startswith("pp_cl.") and getattr(module, "open_device", None) is open_device:
            patch.setattr(module, "open_device", shared)
    return device
