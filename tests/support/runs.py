"""Start, interrupt and resume trainings as a user does; share finished ones among tests."""

import contextlib
import functools
import hashlib
import io
import json
import shutil
from pathlib import Path

from filelock import FileLock
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.engine.step import Trainer

# With these, every mechanism of the loop is due several times within 60 steps.
SETTINGS = {
    "train.iterations": 60,
    "points.count": 1500,
    "raster.radius": 0.85,  # wider points, as such hard pruning leaves gaps
    "network.widths": "16,16,16",
    "train.crop": 24,
    "train.opacity_rate": "0.1,0.01",  # high, so that some points become opaque within 60 steps
    "train.refine_at": "1,1",
    "train.prune_every": 10,
    "train.checkpoint_every": 10,
    "train.log_every": 5,
    "train.prune_weight": 0.5,
}

SPECULAR_STEPS = 8, 8  # of a specular layer's fit in tests, and in the processes that they kill


def arguments(scene, out, downscale=2, **changes):
    """Command line of a small training."""
    sets = set_words(SETTINGS, **changes)
    return ["train", scene, "--out", str(out), "--downscale", str(downscale), *sets]


def rows(out):
    """The rows of a run's log, which may be incomplete."""
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def checkpoint(out):
    """The bytes of a run's checkpoint."""
    return (out / "checkpoint.npz").read_bytes()


def set_words(settings, **changes):
    """The words --set KEY=VALUE for settings; train__crop=8 sets train.crop."""
    settings = settings | {key.replace("__", "."): value for key, value in changes.items()}
    return [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]


def spoken(words):
    """Run a command; returns (exit status, lines on stderr)."""
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        try:
            status = main([str(word) for word in words])
        except SystemExit as end:  # as --help does
            status = end.code or 0
    return status, [line for line in errors.getvalue().splitlines() if line]


class Runs:
    """Scenes and finished runs, each made once for all processes of a test run."""

    def __init__(self, folder):
        self._folder = folder

    def made(self, name, make):
        """The folder `name`, filled once by make(folder); tests must not change it."""
        folder = self._folder / name
        with FileLock(f"{folder}.lock"):
            if not folder.exists():
                try:
                    make(folder)
                except BaseException:
                    shutil.rmtree(folder, ignore_errors=True)
                    raise
        return folder

    def ball(self, **shape):
        """Folder of a scene of write_ball_scene(), as text."""
        make = functools.partial(write_ball_scene, **shape)
        return str(self.made(_name("ball", shape), make))

    def trained(self, out, scene, downscale=2, **changes):
        """Copy the run of a small training on a scene of ball() to `out`. Returns `out`."""

        def train(folder):
            assert main(arguments(scene, folder, downscale, **changes)) == 0

        name = _name(Path(scene).name, {"downscale": downscale} | changes)
        return Path(shutil.copytree(self.made(name, train), out))


def _name(kind, values):
    """A file name made of a kind and a digest of values."""
    text = json.dumps(values, sort_keys=True)
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def train_and_interrupt(scene, out, steps, monkeypatch, **changes):
    """Run a small training and end it with Ctrl-C after `steps` steps."""
    train_step, done = Trainer.train_step, []

    def stopping(self):
        if len(done) == steps:
            raise KeyboardInterrupt
        done.append(0)
        return train_step(self)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", stopping)
        assert main(arguments(scene, out, **changes)) == 130
