"""What tests/test_fuzz.py damages, a small ball in every format and runs of it, and what is right:
input that is taken and sound, or refused in one line with exit status 2.
"""

import contextlib
import faulthandler
import functools
import importlib
import json
import os
import resource
import shutil
import signal
import warnings
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from support import runs
from support.checkpoints import load_checkpoint
from support.scenes import ball_image, ring_cameras

from pp_cl.engine.step import Trainer
from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from tools.convert_scene import dealt

LONGEST = 60  # seconds for an input
MEMORY = 6 * 2**30  # bytes of addresses more than when the module began; PoCL takes some
MOST_MESSAGE = 1500  # characters of a refusal: two paths and a reason
SIDE, STEPS = 16, 4
# {surface: (module of tools/scene_formats, arguments of its write(), where the scene lies in it)}
FORMATS = {
    **{name: (name, {}, "") for name in ("nerf_synthetic", "nerfstudio", "neus", "nsvf", "llff")},
    "colmap": ("colmap", {"binary": True}, ""),
    "colmap text": ("colmap", {"binary": False}, ""),
    "co3d": ("co3d", {"version": 2}, "object/sequence"),
    "co3d 1": ("co3d", {"version": 1}, "object/sequence"),
}
SETTINGS = {
    "train.iterations": STEPS,
    "points.count": 300,
    "network.widths": "16,16,16",
    "train.crop": 12,
    "train.prune_weight": 0.0,
    "train.checkpoint_every": 2,
    "train.log_every": 1,
    "scene.downscale": 1,
}


# --set words of a training that takes a moment
set_words = functools.partial(runs.set_words, SETTINGS)


def ball_views():
    """The splits of a ball at the origin, seen from around it."""
    cameras = enumerate(ring_cameras(5, SIDE))
    return dealt(
        {"train": [View(f"r_{i}.png", camera, ball_image(camera)) for i, camera in cameras]}
    )


class World:
    """Templates below a folder, each made when it is asked for, and the device of all runs."""

    def __init__(self, folder, device):
        self._folder, self.device = folder, device
        self.cache = folder / "cache"

    def scene(self, name="nerf_synthetic", folder=None):
        """The scene in a format, or a copy of it in a folder."""
        module, options, place = FORMATS[name]
        files = self._folder / name
        if not files.exists():
            files.mkdir()
            module = importlib.import_module(f"tools.scene_formats.{module}")
            module.write(files, ball_views(), **options)
        return (shutil.copytree(files, folder / "scene") if folder else files) / place

    @cached_property
    def _runs(self):
        """One that has come to its end and was evaluated, and one that was interrupted."""
        finished, unfinished = self._folder / "finished", self._folder / "unfinished"
        words = ["train", self.scene(), *set_words(), "--out"]
        assert command(*words, finished) == command("eval", finished) == 0
        step = Trainer.train_step

        def stopping(trainer):
            if trainer.step == STEPS - 1:
                raise KeyboardInterrupt
            return step(trainer)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Trainer, "train_step", stopping)
            assert command(*words, unfinished) == 130
        return {True: finished, False: unfinished}

    def run(self, folder, *, finished=True):
        """A copy of such a run."""
        return RunFolder(shutil.copytree(self._runs[finished], folder / "run"))

    @contextlib.contextmanager
    def watched(self):
        """An empty folder to work in, which is the current one; a hang is a failure, and so is a
        warning that is not pp-cl's own.
        """
        folder, before = self._folder / "input", os.getcwd()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        os.chdir(folder)
        signal.alarm(LONGEST)
        faulthandler.dump_traceback_later(2 * LONGEST, exit=True)  # one outside of Python
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", append=True)  # behind what is left out on purpose
                warnings.filterwarnings("ignore", module=r"PIL\.")  # as pp_cl/files/image.py does
                yield folder
        except Hang as hang:
            raise AssertionError(f"no end after {LONGEST} s") from hang
        finally:
            signal.alarm(0)
            faulthandler.cancel_dump_traceback_later()
            os.chdir(before)
        for one in caught:
            ours = one.category is UserWarning and (
                "pp_cl" in one.filename or "fuzz" in one.filename
            )
            assert ours, f"{one.filename}:{one.lineno}: {one.category.__name__}: {one.message}"
            check_line(str(one.message))


class Hang(BaseException):
    """An input took too long. Not an Exception: readers turn those into messages."""


def _hang(*_):
    raise Hang


@contextlib.contextmanager
def opened_world(folder, device):
    """A World with the device that commands work on."""
    world = World(folder, device)
    world.cache.mkdir()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGALRM, _hang)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PP_CACHE", str(world.cache))
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
        try:
            world.run(folder, finished=True)  # builds the kernels, which no input has to wait for
            yield world
        finally:
            resource.setrlimit(resource.RLIMIT_AS, limits)
            signal.signal(signal.SIGALRM, handler)


# --------------------------------------------------------------------------------------------------


def taken(function):
    """What a reader returns, None where it refuses; what else it raises is a failure."""
    try:
        return function()
    except UserError as error:
        check_line(str(error))
    except OSError:  # of which the command line makes a line
        pass
    return None


def command(*words):
    """The exit status of the command line: 0, 2 with one line as the last, or 130."""
    status, lines = runs.spoken(words)
    assert status in (0, 2, 130), lines[-1:]
    if status == 2:
        assert lines and lines[-1].startswith(("pp-cl: ", "pp-cl ")), lines[-1:]
        assert "no memory left" not in lines[-1]
        check_line(lines[-1])
    return status


def check_line(message):
    """A message is one line that a terminal shows."""
    assert message.isprintable() and len(message) <= MOST_MESSAGE, message[:200]


def check_finite(**named):
    """No number in values or arrays is NaN or infinite."""
    for name, values in named.items():
        numbers = np.asarray(values)
        assert numbers.dtype.kind not in "fc" or np.isfinite(numbers).all(), (name, values)


def strict_json(file):
    """What a file of JSON holds; NaN in it is a failure."""

    def refuse(name):
        raise AssertionError(f"{name} written to {file.name}")

    texts = file.read_text("utf-8")
    texts = texts.splitlines() if file.suffix == ".jsonl" else [texts]
    return [json.loads(text, parse_constant=refuse) for text in texts]


def check_written(folder):
    """What a command has written into a run is whole and finite."""
    check_finite(**load_checkpoint(folder / "checkpoint.npz")[1])
    strict_json(folder / "log.jsonl")
    for file in folder.rglob("metrics.json"):
        mean = strict_json(file)[0]["mean"]
        check_finite(**mean)
        assert -1 <= mean["ssim"] <= 1 and -10 <= mean["psnr"] <= 100, mean
    assert not list(folder.rglob(".*.tmp*"))
