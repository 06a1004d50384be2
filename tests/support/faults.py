"""Make single calls that change files fail, and check what a command leaves after a fault.

python -m support.faults FOLDER CALL WORDS...    # runs a command that is killed before a call
"""

import contextlib
import errno
import io
import json
import os
import re
import signal
import sys
from pathlib import Path
from unittest.mock import patch
from zipfile import BadZipFile

from support.checkpoints import load_checkpoint
from support.runs import SPECULAR_STEPS, spoken

from pp_cl.cli import program
from pp_cl.engine.training import specular
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.files.run_folder import read_row

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
TIMES = ("seconds", "seconds_per_frame")  # keys whose values differ in all runs
# marks without content, and a list of files that also has those of failed tries
BESIDE = (".pp-cl.lock", ".pp-cl.owner", ".pp-cl-files.jsonl")
LEFTOVER = re.compile(r"\..*\.tmp")
PREVIEW = re.compile(r"previews/step_\d+\.png")  # the clock may ask for an early one


class Faults(contextlib.ExitStack):
    """Within the block, one of the calls that change something below a folder fails.

    call: which one, from 1 on; 0: none. number: its errno; 0: the process is killed before it.
    stays: later calls that take space fail, too. calls: "kind path" of each call so far.
    """

    def __init__(self, folder, call=0, number=errno.EIO, *, stays=False):
        super().__init__()
        self.folder, self.call, self.number, self.stays = str(folder), call, number, stays
        self.calls = []

    def __enter__(self):
        import fcntl  # only on Unix; what else is here is also for other systems

        for module, name in ((os, "mkdir"), (os, "unlink"), (os, "remove"), (os, "rmdir")):
            self._fail(module, name, lambda path, *_, dir_fd=None, **__: _place(path, dir_fd))
        self._fail(os, "replace", lambda _, path, **__: path)
        self._fail(os, "fsync", lambda file: _place(file))
        self._fail(fcntl, "flock", lambda file, _: _place(file))
        self._fail(os, "open", lambda path, flags, *_, **__: path if flags & WRITING else "")
        for module in ("builtins", "io"):
            self.enter_context(patch(f"{module}.open", self._open))
        return self

    def _fail(self, module, name, place):
        real = getattr(module, name)

        def call(*words, **more):
            self.count(name, place(*words, **more))
            return real(*words, **more)

        self.enter_context(patch.object(module, name, call))

    def count(self, kind, path):
        """Count a call; raise OSError, or die, if this call is to fail."""
        name = os.path.relpath(os.fspath(path), self.folder) if path else ".."
        if name.startswith("..") and not name.startswith("..."):
            return
        self.calls.append(f"{kind} {name}")
        later = self.stays and kind in ("open", "write", "mkdir", "fsync")
        if len(self.calls) == self.call or (later and len(self.calls) > self.call > 0):
            if not self.number:
                os.kill(os.getpid(), signal.SIGKILL)
            named = [] if kind in ("write", "fsync", "close", "flock") else [str(path)]
            raise OSError(self.number, os.strerror(self.number), *named)

    def _open(self, file, mode="r", buffering=-1, encoding=None, *more, _real=open, **named):
        inside = isinstance(file, (str, Path)) and str(file).startswith(self.folder)
        if not inside or not set(mode) & set("wax"):
            return _real(file, mode, buffering, encoding, *more, **named)
        self.count("open", file)
        raw = _File(self, file, mode.replace("b", ""))
        if "b" not in mode:
            return io.TextIOWrapper(io.BufferedWriter(raw), encoding or "utf-8")
        return raw if buffering == 0 else io.BufferedWriter(raw)


class _File(io.FileIO):
    """A file that writes half when a write fails, as on a full disk, and always closes."""

    def __init__(self, faults, path, mode):
        self._faults = faults
        super().__init__(path, mode)

    def write(self, data):
        try:
            self._faults.count("write", self.name)
        except OSError:
            super().write(data[: len(data) // 2])
            raise
        return super().write(data)

    def close(self):
        was_open = not self.closed
        super().close()
        if was_open:
            self._faults.count("close", self.name)


def _place(path, folder=None):
    """The path of a descriptor, or of a name in the folder of a descriptor."""
    if isinstance(path, int):
        return os.readlink(f"/proc/self/fd/{path}")
    return path if folder is None else os.path.join(_place(folder), path)


def run_command(words, run=""):
    """(exit status, problems with how the command ended). It may warn, but its last line alone must
    tell the error and name a file of the run.
    """
    try:
        status, lines = spoken(words)
    except Exception as error:
        return 1, [repr(error)]
    errors = [line for line in lines if line.startswith(("pp-cl: ", "pp-cl "))]
    wrong = [] if status in (0, 2) else [f"status {status}"]
    if status and (len(errors) != 1 or lines[-1] != errors[0] or str(run) not in errors[0]):
        wrong.append(f"{len(errors)} lines tell of it: {lines[-3:]}")
    return status, wrong


def content(run):
    """{path below the run: bytes without times} of all files under final names."""
    files = {}
    for path in sorted(p for p in run.rglob("*") if p.is_file()):
        if LEFTOVER.match(path.name) or path.name in BESIDE:
            continue
        data = path.read_bytes()
        if path.name == "log.jsonl":
            rows = [read_row(line) for line in data.splitlines(True) if line.endswith(b"\n")]
            data = json.dumps([_timeless(row) for row in rows if row]).encode()
        elif path.name == "metrics.json" and not _problem(path):
            data = json.dumps(_timeless(json.loads(data))).encode()
        files[path.relative_to(run).as_posix()] = data
    return files


def _timeless(row):
    return {name: value for name, value in row.items() if name not in TIMES}


def leftovers(run):
    """A line for each temporary file in a run."""
    return [f"left {p.relative_to(run)}" for p in run.rglob("*") if LEFTOVER.match(p.name)]


def half_written(run):
    """A line for each incomplete file under a final name; a log's last row may be incomplete."""
    paths = [p for p in run.rglob("*") if p.is_file() and p.name not in BESIDE]
    problems = [(path, _problem(path)) for path in paths if not LEFTOVER.match(path.name)]
    return [f"{path.relative_to(run)}: {problem}" for path, problem in problems if problem]


def _problem(path):
    """What is wrong with a file; "" if nothing is."""
    try:
        if path.suffix == ".npz":
            load_checkpoint(path)
        elif path.suffix == ".png":
            read_rgba(path)
        elif path.suffix == ".json":
            json.loads(path.read_bytes())
        else:
            lines = path.read_bytes().split(b"\n")[:-1]
            is_log = path.name == "log.jsonl"
            return "" if is_log and all(map(read_row, lines)) else "broken or unknown"
    except (UserError, ValueError, BadZipFile) as error:
        return str(error)
    return ""


def differences(run, expected):
    """A line for each file of a run that differs from `expected`, is missing or is new."""
    files = content(run)
    names = sorted(n for n in files.keys() | expected.keys() if files.get(n) != expected.get(n))
    words = {True: "differs", False: "is missing"}
    return [
        f"{name} {words[name in files] if name in expected else 'is new'}"
        for name in names
        if name in expected or not PREVIEW.fullmatch(name)
    ]


if __name__ == "__main__":
    specular.STEPS = SPECULAR_STEPS
    with Faults(sys.argv[1], int(sys.argv[2]), 0):
        sys.exit(program(sys.argv[3:]))
