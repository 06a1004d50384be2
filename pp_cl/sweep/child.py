"""The process of one run: `python -m pp_cl.sweep.child` with a job on its standard input, which
stays open. When it closes, whoever wanted the run is gone or wants it no more: the training writes
its checkpoint and ends.
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

from filelock import FileLock

from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import evaluate, load_run
from pp_cl.scene.load import scene_splits
from pp_cl.session import is_finished, open_training, run_config, stored_state
from pp_cl.sweep.plan import Job

LONGEST = 600  # seconds, at most, from the wish to end to the end: a step and a checkpoint


class Wish:
    """Whether the run is to end early: is_over() is true once standard input is closed, or after
    SIGTERM. Outside of a training, where nothing is lost by it, the process ends at once.
    """

    def __init__(self) -> None:
        self._over, self._training = threading.Event(), False
        # Ctrl-C in a terminal reaches all its processes, but it is the sweep that decides
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, lambda *_: self._over.set())
        threading.Thread(target=self._await_end_of_input, daemon=True).start()
        threading.Thread(target=self._end, daemon=True).start()

    def is_over(self) -> bool:
        """Whether the training is to write its checkpoint and end."""
        return self._over.is_set()

    def __enter__(self) -> "Wish":
        self._training = True
        return self

    def __exit__(self, *_: object) -> None:
        self._training = False

    def _await_end_of_input(self):
        # not sys.stdin.read(), which would hold a lock that the interpreter wants at its end
        while os.read(sys.stdin.fileno(), 1):
            pass
        self._over.set()

    def _end(self):
        self._over.wait()
        last = time.monotonic() + LONGEST
        while self._training and time.monotonic() < last:
            time.sleep(0.05)
        os._exit(0)


def main() -> None:
    """Train and evaluate the job of the first line of standard input. A UserError or a fault of the
    system is the last line of standard error, with exit status 1.
    """
    job = Job.from_json(sys.stdin.readline())
    wish = Wish()
    try:
        Path(job.folder).mkdir(parents=True, exist_ok=True)
        # the process of a worker that was killed may still be writing its checkpoint
        with FileLock(job.lock):
            _train(job, wish)
            _evaluate(job)
    except UserError as error:
        sys.exit(str(error))
    except OSError as error:
        sys.exit(f"{error.filename or job.folder}: {error.strerror or error}; check the disk")
    except MemoryError:
        sys.exit("the host has no memory left; lower points.count or raise scene.downscale")


def _train(job, wish):
    """Train to the end, from the checkpoint if there is one; nothing where the end is reached."""
    if "test" not in scene_splits(job.scene):
        raise UserError(f"{job.scene}: has no split test, which a sweep measures; add one")
    folder = RunFolder(job.folder)
    config = run_config(folder, job.scene, job.preset, job.given)
    stored = stored_state(folder, config)
    if is_finished(stored, config):
        return
    training = open_training(open_device(), folder, config, stored)
    with wish:
        training.run(is_stopped=wish.is_over)


def _evaluate(job):
    evaluate(load_run(open_device(), job.folder), "test", job.metrics)


if __name__ == "__main__":
    main()
