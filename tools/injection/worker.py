"""Processes that run pp-cl again and again while tools/injection/shim.c counts its calls.

A warm worker runs a command in its own process and keeps the device with its programs, which is
quick. A forking one does so in a child that opens the device for itself and may be killed.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCE = Path(__file__).with_name("shim.c")


@dataclass(frozen=True)
class Job:
    """A command and its faults. words: of pp-cl; folder: whose calls are counted, absolute. call:
    that fails, from 1 on, with the errno `error`, or kills where that is 0. signals: (seconds after
    the start, number). is_backwards: the clock.
    """

    words: list[str]
    folder: str
    call: int = 0
    error: int = 0
    signals: list[tuple[float, int]] = field(default_factory=list)
    is_backwards: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of a job. status: as Popen.returncode. calls: "kind path" of each that was
    counted. seconds: it took.
    """

    status: int
    out: str
    errors: str
    calls: list[str]
    seconds: float


def build_shim(folder: Path) -> Path:
    """The compiled shim. Raises OSError where there is no cc, CalledProcessError where it fails."""
    folder.mkdir(parents=True, exist_ok=True)
    library = folder / "shim.so"
    if not library.exists() or library.stat().st_mtime < SOURCE.stat().st_mtime:
        words = ["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE), "-ldl"]
        subprocess.run(words, check=True)
    return library


class Worker:
    """The other end of such a process, until close()."""

    def __init__(self, library: Path, *, forks: bool) -> None:
        self._texts = tempfile.TemporaryDirectory()
        words = [sys.executable, "-m", "tools.injection.worker", self._texts.name]
        self._process = subprocess.Popen(
            words + ["--fork"] * forks,
            cwd=ROOT,
            env={**os.environ, "LD_PRELOAD": str(library), "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, job: Job) -> Outcome:
        """Run a job to its end."""
        self._process.stdin.write(json.dumps(asdict(job)) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        out, errors, calls = (
            Path(self._texts.name, name).read_text("utf-8", "replace")
            for name in ("out", "errors", "calls")
        )
        return Outcome(answer["status"], out, errors, calls.splitlines(), answer["seconds"])

    def close(self) -> None:
        """Let the process end."""
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._texts.cleanup()


# --------------------------------------------------------------------------------------------------
# in the process


def _serve(folder, forks):
    """Answer jobs until there are none."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    texts = [folder / "out", folder / "errors"]
    _import_all()
    if not forks:
        _keep_device()
    for line in sys.stdin:
        job = Job(**json.loads(line))
        start = time.perf_counter()
        for path in texts:
            path.write_text("")
        if forks:
            child = os.fork()
            if not child:
                _into(texts)
                _arm(job, folder / "calls")
                sys.exit(_main(job.words, "program"))
            status = _wait(child, job.signals)
        else:
            _into(texts)
            _arm(job, folder / "calls")
            status = _main(job.words)
            _arm(None, folder / "calls")
        seconds = time.perf_counter() - start
        answers.write(json.dumps({"status": status, "seconds": seconds}) + "\n")
        answers.flush()


def _import_all():
    """What the commands import when they begin; none of it opens a device."""
    import pp_cl.bench.plots
    import pp_cl.cli
    import pp_cl.commands.progress
    import pp_cl.evaluate
    import pp_cl.view.serve

    pp_cl.cli._parser()


def _keep_device():
    """One device for all commands."""
    from functools import cache

    from pp_cl.device import discover

    discover.open_device = cache(discover.open_device)


def _main(words, name="main"):
    """Exit status of a command, by a function of pp_cl.cli."""
    import pp_cl.cli

    try:
        status = getattr(pp_cl.cli, name)(words)
    except SystemExit as stopped:
        status = stopped.code
    except BaseException:
        traceback.print_exc()
        status = 1
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    return status


def _into(paths):
    """What is written to stdout and stderr goes into files from now on."""
    for number, path in enumerate(paths, 1):
        file = os.open(path, os.O_WRONLY | os.O_TRUNC | os.O_APPEND)
        os.dup2(file, number)
        os.close(file)


def _arm(job, calls):
    """Tell the shim; nothing fails without a job, and no call counts."""
    import ctypes

    shim = ctypes.CDLL(None)
    if job is None:
        shim.faults_disarm()
        return
    shim.faults_arm(job.folder.encode(), ctypes.c_long(job.call), job.error, str(calls).encode())
    if job.is_backwards:
        shim.faults_turn_clock()


def _wait(child, signals):
    """Exit status of a child that gets signals."""
    start = time.monotonic()
    for seconds, number in sorted(signals):
        while (left := start + seconds - time.monotonic()) > 0:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(min(left, 0.005))
        os.kill(child, signal.Signals(number))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="runs the jobs on stdin")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fork", action="store_true")
    given = parser.parse_args()
    _serve(given.folder, given.fork)
