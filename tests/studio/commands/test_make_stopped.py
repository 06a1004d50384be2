"""`pp-cl make` is stopped by signals at moments of all its stages: one line within seconds, the
status of the signal, and the same command comes to the result of one that nothing stopped.
"""

import signal
import subprocess
import sys
import time
from itertools import cycle

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
    """The command that makes something of a scene in so many steps as no clock decides."""
    begin_result(out)
    folder = RunFolder(out / "run")
    given = {**SETTINGS, "train.iterations": 300, "scene.downscale": 1}
    config = run_config(folder, scene, "tiny", [(*one, "test") for one in given.items()])
    folder.create(config.to_json())
    return [sys.executable, "-m", "pp_cl", "make", scene, "--out", str(out)]


def started(words):
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def begins(process, stage):
    """Whether the process comes to a stage, or a later one; it is then at its beginning."""
    marks = tuple(f"== pp-cl {name} " for name in STAGES[STAGES.index(stage) :])
    return any(line.startswith(marks) for line in iter(process.stdout.readline, ""))


def result(out):
    """{path: bytes} of what no clock decides."""
    files = content(out)
    return {
        name: data for name, data in files.items() if not name.endswith((".html", "minutes.json"))
    }


def test_any_moment_will_do(runs, tmp_path):
    scene = runs.ball(views=12, size=32)
    words, seconds = begun(scene, tmp_path / "whole"), []
    with started(words) as process:
        for stage in STAGES:
            assert begins(process, stage)
            seconds.append(time.monotonic())
        process.communicate()
        seconds.append(time.monotonic())
    assert process.returncode == 0
    took = {stage: b - a for stage, a, b in zip(STAGES, seconds, seconds[1:], strict=False)}
    expected = result(tmp_path / "whole")

    words, wrong, stopped = begun(scene, tmp_path / "out"), [], []
    numbers = cycle([signal.SIGINT, signal.SIGTERM])
    for moment, number in zip(range(MOMENTS), numbers, strict=False):
        stage = STAGES[moment * len(STAGES) // MOMENTS]
        part = (moment % (MOMENTS // len(STAGES)) + 0.5) / (MOMENTS // len(STAGES))
        for name in MADE.get(stage, ()):  # by an attempt that came further
            (tmp_path / "out" / name).unlink(missing_ok=True)
        with started(words) as process:
            if not begins(process, stage):
                process.communicate()
                continue
            time.sleep(part * took[stage])
            if process.poll() is not None:  # what is kept of a render made this one short
                continue
            process.send_signal(number)
            start = time.monotonic()
            _, err = process.communicate()
            late = time.monotonic() - start
        told = [line for line in err.splitlines() if line.startswith("pp-cl: ")]
        stopped.append(
            (stage, round(part, 2), number.name, process.returncode, round(late, 2), told)
        )
        if process.returncode != 128 + number or len(told) != 1 or late > LATEST:
            wrong.append((*stopped[-1], err[-500:]))
    print(*stopped, sep="\n")
    assert wrong == [] and len(stopped) >= 0.8 * MOMENTS
    with started(words) as process:
        process.communicate()
    assert process.returncode == 0
    found = result(tmp_path / "out")
    assert found.keys() == expected.keys()
    assert [name for name in expected if found[name] != expected[name]] == []
