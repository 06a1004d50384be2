"""Signals stop `pp-cl make` at moments of all its stages: it prints one line within seconds and
exits with the signal's status, and the same command then gives the result of an undisturbed one.
"""

import signal
import subprocess
import sys
import time
from subprocess import PIPE

import pytest
from support.faults import content
from support.runs import SETTINGS

from pp_cl.config import run_config
from pp_cl.files.run_folder import RunFolder
from pp_studio.export.result import begin_result

pytestmark = [pytest.mark.unix, pytest.mark.slow]
LATEST = 5  # seconds from a signal to the end of the process
MOMENTS = 20
STAGES = ("train", "eval", "export", "render")
MADE = {"export": ["splat.ply", "run/gaussians.npz"], "render": ["video.mp4", "video.webp"]}


def begun(scene, out):
    """The words of a `make` command whose training has a fixed number of steps, which no clock
    changes.
    """
    begin_result(out)
    folder = RunFolder(out / "run")
    settings = {**SETTINGS, "train.iterations": 300, "scene.downscale": 1}
    config = run_config(folder, scene, "tiny", [(*setting, "test") for setting in settings.items()])
    folder.create(config.to_json())
    return [sys.executable, "-m", "pp_cl", "make", scene, "--out", str(out)]


def begins(process, stage):
    """Wait until the process begins `stage` or a later one. Returns False if it ends first."""
    marks = tuple(f"== pp-cl {name} " for name in STAGES[STAGES.index(stage) :])
    return any(line.startswith(marks) for line in iter(process.stdout.readline, ""))


def result(out):
    files = content(out)
    return {name: data for name, data in files.items() if not name.endswith((".html", "make.json"))}


def test_any_moment_will_do(runs, tmp_path):
    scene = runs.ball(views=12, size=32)
    words = begun(scene, tmp_path / "whole")
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    expected = result(tmp_path / "whole")

    words, wrong, stopped = begun(scene, tmp_path / "out"), [], 0
    for moment in range(MOMENTS):
        stage, part = STAGES[moment * len(STAGES) // MOMENTS], moment % (MOMENTS // len(STAGES))
        number = (signal.SIGINT, signal.SIGTERM)[moment % 2]
        for name in MADE.get(stage, ()):  # an earlier attempt may have made it
            (tmp_path / "out" / name).unlink(missing_ok=True)
        with subprocess.Popen(words, stdout=PIPE, stderr=PIPE, text=True) as process:
            if not begins(process, stage):
                continue
            time.sleep(0.3 * part)
            if process.poll() is not None:  # a kept part of a render made it end early
                continue
            process.send_signal(number)
            start = time.monotonic()
            _, err = process.communicate()
        lines = [line for line in err.splitlines() if line.startswith("pp-cl: ")]
        late, ended = time.monotonic() - start > LATEST, process.returncode
        stopped += ended == 128 + number
        if late or (ended, len(lines)) not in ((0, 0), (128 + number, 1)):
            wrong.append((stage, part, ended, err[-500:]))
    assert wrong == [] and stopped >= 0.6 * MOMENTS
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    files = result(tmp_path / "out")
    assert files.keys() == expected.keys()
    assert [name for name in expected if files[name] != expected[name]] == []
