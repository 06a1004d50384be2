"""The process of a run: one at a time in a folder, ending when nobody wants it."""

import io
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from filelock import FileLock
from support.scenes import write_ball_scene
from support.sweeps import jobs_of, pretend

from pp_cl.errors import UserError
from pp_cl.sweep import child

ROOT = Path(__file__).parents[2]


@pytest.fixture
def job(tmp_path):
    """A planned run of the demo."""
    return jobs_of(["demo"], tmp_path / "out", [4])[0]


@pytest.fixture
def called(job, monkeypatch):
    """main() with the job on its input, in this process; lists what it calls."""
    names = []
    monkeypatch.setattr(sys, "stdin", io.StringIO(job.to_json() + "\n"))
    monkeypatch.setattr(child, "Wish", lambda: None)
    monkeypatch.setattr(child, "_train", lambda *_: names.append("train"))
    monkeypatch.setattr(child, "_evaluate", lambda *_: names.append("evaluate"))
    return names


def test_it_waits_for_the_one_that_has_the_folder(job, called):
    Path(job.folder).mkdir(parents=True)
    thread = threading.Thread(target=child.main)
    with FileLock(job.lock):
        thread.start()
        thread.join(0.5)
        assert thread.is_alive() and not called
    thread.join(20)
    assert called == ["train", "evaluate"]


@pytest.mark.parametrize(
    "error, said",
    [
        (UserError("x: mend it"), "x: mend it"),
        (OSError(28, "No space left", "a.npz"), "a.npz: No space left; check the disk"),
        (MemoryError(), "the host has no memory left"),
    ],
)
def test_what_goes_wrong_is_one_line(called, monkeypatch, error, said):
    def failing(*_):
        raise error

    monkeypatch.setattr(child, "_train", failing)
    with pytest.raises(SystemExit) as caught:
        child.main()
    assert str(caught.value.code).startswith(said) and not called


def test_a_scene_that_cannot_be_measured_is_not_trained(tmp_path):
    scene = write_ball_scene(tmp_path / "ball", splits=("train",))
    (job,) = jobs_of([scene], tmp_path / "out")
    with pytest.raises(UserError, match="no split test"):
        child._train(job, None)


def test_a_finished_training_is_not_begun_again(job, monkeypatch):
    pretend(job, 20.0)
    monkeypatch.setattr(child, "open_training", None)
    child._train(job, None)


def test_it_ends_when_its_input_does(job):
    """While it waits for the folder: it has nothing to save."""
    Path(job.folder).mkdir(parents=True)
    with FileLock(job.lock):
        done = subprocess.run(
            [sys.executable, "-m", "pp_cl.sweep.child"],
            input=job.to_json() + "\n",
            text=True,
            cwd=ROOT,
            capture_output=True,
            timeout=60,
            env=os.environ | {"PP_DEVICE": "none"},
        )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


TERMINATED = """
import os, signal, time
from pp_cl.sweep.child import Wish
wish = Wish()
with wish:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.2)
    print(wish.is_over(), flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.2)
    print(wish.is_over(), flush=True)
time.sleep(60)
print("too late", flush=True)
"""


def test_a_training_that_is_terminated_may_save_and_no_more():
    """Ctrl-C is left to the sweep."""
    command = [sys.executable, "-c", TERMINATED]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout.read() == "False\nTrue\n"
        assert process.wait(timeout=30) == 0
