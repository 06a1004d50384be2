"""If a call that changes files fails or the process is killed, there is one line of error, no half
written file under its final name, and the next start gives the bytes of an undisturbed run.

A few faults of each kind are tried here; `make faults` (FAULTS=all) tries all.
"""

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from support.faults import (
    Faults,
    content,
    differences,
    half_written,
    leftovers,
    run_command,
)
from support.runs import arguments
from support.scenes import write_ball_scene

ROOT = Path(__file__).parents[1]
ALL = os.environ.get("FAULTS") == "all"
PARTS = range(8 if ALL else 1)  # the workers share them
KILLS = 8 if ALL else 2  # kills in each part
pytestmark = [
    pytest.mark.unix,
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks /proc"),
    pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning"),
]
# every mechanism of the loop runs within these steps
CHANGES = {
    "train__iterations": 30,
    "points__count": 300,
    "network__blocks": "single",
    "train__crop": 0,
    "train__log_every": 5,
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(tmp_path_factory.mktemp("faults").resolve())


class Bench:
    """A folder with a scene and templates of runs. run: the folder that the faults disturb."""

    def __init__(self, folder):
        scene, self.run = write_ball_scene(folder / "scene", 4, 16), folder / "run"
        train = arguments(scene, self.run, downscale=1, **CHANGES)
        evaluate = ["eval", str(self.run), "--save-images"]
        interrupted, trained, evaluated = (
            folder / name for name in ("cut", "trained", "evaluated")
        )
        last = numbers(self.calls(None, train), "replace checkpoint.npz")[-1]
        shutil.copytree(self.run, trained)
        with Faults(self.run, last):
            restore(self.run, None)
            run_command(train)
        shutil.copytree(self.run, interrupted)
        self.calls(trained, evaluate)
        shutil.copytree(self.run, evaluated)
        # {name: (the run's template, or None, command, the files at an undisturbed end)}
        self.commands = {
            "training": (None, train, content(trained)),
            "training that goes on": (interrupted, train, content(trained)),
            "evaluation": (trained, evaluate, content(evaluated)),
            "evaluation again": (evaluated, evaluate, content(evaluated)),
        }
        self._seen = set()  # states from which the next start ended correctly

    def calls(self, begin, words):
        restore(self.run, begin)
        with Faults(self.run) as faults:
            assert run_command(words) == (0, [])
        assert not half_written(self.run) + leftovers(self.run)
        return faults.calls

    def left(self, name, *, may_leave=False):
        _, words, expected = self.commands[name]
        files_left = leftovers(self.run)
        wrong = half_written(self.run) + ([] if may_leave else files_left)
        files = frozenset(content(self.run).items())
        if (name, files, bool(files_left)) not in self._seen:
            after = run_command(words)[1] + differences(self.run, expected) + leftovers(self.run)
            wrong += [f"the next start: {line}" for line in after]
            if not after:
                self._seen.add((name, files, bool(files_left)))
        return wrong


def restore(run, begin):
    shutil.rmtree(run, ignore_errors=True)
    if begin:
        shutil.copytree(begin, run)


def numbers(calls, beginning):
    return [n for n, call in enumerate(calls, 1) if call.startswith(beginning)]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(
    "name", ["training", "training that goes on", "evaluation", "evaluation again"]
)
def test_a_call_that_fails(bench, name, part):
    """The fault comes once, as from a broken disk, or stays, as from a full one."""
    begin, words, expected = bench.commands[name]
    calls, wrong = bench.calls(begin, words), []
    tried = range(1, len(calls) + 1)
    if not ALL:  # only the last call of each kind
        tried = sorted({call.split()[0]: n for n, call in enumerate(calls, 1)}.values())
    for number in tried[part :: len(PARTS)]:
        restore(bench.run, begin)
        code, stays = ((errno.EIO, False), (errno.ENOSPC, True))[number % 2]
        with Faults(bench.run, number, code, stays=stays) as faults:
            status, problems = run_command(words, bench.run)
        assert len(faults.calls) >= number
        if status == 0:
            problems += differences(bench.run, expected)
        kind = faults.calls[number - 1].split()[0]
        problems += bench.left(name, may_leave=kind in ("unlink", "rmdir"))
        wrong += [f"call {number} ({faults.calls[number - 1]}): {line}" for line in problems]
    assert wrong == []


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("name", ["training", "evaluation"])
def test_a_process_that_is_killed(bench, name, part):
    """The process is killed again and again, at random moments and before random calls; sometimes
    it reaches its end.
    """
    begin, words, expected = bench.commands[name]
    rng, count = np.random.default_rng(part), len(bench.calls(begin, words))
    restore(bench.run, begin)
    killed, ended, wrong = 0, 0, []
    while killed < KILLS and ended < KILLS:
        call = int(rng.integers(1, count + 1)) if killed % 2 == 0 else 0
        process = subprocess.Popen(
            [sys.executable, "-m", "support.faults", bench.run, str(call), *words],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
            stdout=subprocess.DEVNULL,
        )
        if not call:
            time.sleep(rng.uniform(0.5, 4))
            process.kill()
        status = process.wait(120)
        wrong += half_written(bench.run)
        if status == -signal.SIGKILL:
            killed += 1
            continue
        ended += 1
        wrong += [f"status {status}"] if status else []
        wrong += differences(bench.run, expected) + leftovers(bench.run)
        restore(bench.run, begin)
    wrong += bench.left(name, may_leave=True)
    assert wrong == [] and killed
