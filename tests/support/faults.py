"""Calls that change files, failing one by one; and what a command must leave after a fault.

python -m support.faults FOLDER CALL WORDS...    # a command that kills itself before a call
"""

import contextlib
import errno
import fcntl
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
from support.runs import spoken

from pp_cl.cli import program
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.files.run_folder import read_row

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
TIMES = ("seconds", "seconds_per_frame")  # what no two runs have in common
# marks without content of their own, and what knows of a try that failed, too
BESIDE = (".pp-cl.lock", ".pp-cl.owner", ".pp-cl-files.jsonl")
LEFTOVER = re.compile(r"\..*\.tmp")
PREVIEW = re.compile(r"previews/step_\d+\.png")  # the clock asks for an early one


class Faults(contextlib.ExitStack):
    """While it is entered, one of the calls that change something below a folder fails.

    call: which, from 1 on, 0 for none. number: its errno, 0: the process is killed in front of it.
    stays: all that take space fail from then on. calls: "kind path" of each that came.
    """

    def __init__(self, folder, call=0, number=errno.EIO, *, stays=False):
        super().__init__()
        self.folder, self.call, self.number, self.stays = str(folder), call, number, stays
        self.calls = []

    def __enter__(self):
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
        """Count a call; raise OSError, or die, where it is the one."""
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
    """A file that writes a half of what fails, as a full disk does, and is closed in any case."""

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
    """The path of a descriptor, or of a name in the folder of one."""
    if isinstance(path, int):
        return os.readlink(f"/proc/self/fd/{path}")
    return path if folder is None else os.path.join(_place(folder), path)


def run_command(words, run=""):
    """(exit status, what is wrong with how it ended): it may warn, and tells of its end in one
    line, which names a file of the run.
    """
    try:
        status, lines = spoken(words)
    except Exception as error:
        return 1, [repr(error)]
    told = [line for line in lines if line.startswith(("pp-cl: ", "pp-cl "))]
    wrong = [] if status in (0, 2) else [f"status {status}"]
    if status and (len(told) != 1 or lines[-1] != told[0] or str(run) not in told[0]):
        wrong.append(f"{len(told)} lines tell of it: {lines[-3:]}")
    return status, wrong


def content(run):
    """{path below the run: bytes, times left out} of all files under final names."""
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
    """A line for each file under a final name that is not whole; the last row of a log may be."""
    paths = [p for p in run.rglob("*") if p.is_file() and p.name not in BESIDE]
    found = [(path, _problem(path)) for path in paths if not LEFTOVER.match(path.name)]
    return [f"{path.relative_to(run)}: {problem}" for path, problem in found if problem]


def _problem(path):
    """What is wrong with a file, "" where nothing is."""
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
    """A line for each file that differs, is missing or is new."""
    found = content(run)
    names = sorted(n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n))
    words = {True: "differs", False: "is missing"}
    return [
        f"{name} {words[name in found] if name in expected else 'is new'}"
        for name in names
        if name in expected or not PREVIEW.fullmatch(name)
    ]


if __name__ == "__main__":
    with Faults(sys.argv[1], int(sys.argv[2]), 0):
        sys.exit(program(sys.argv[3:]))
