"""With this folder in PYTHONPATH (`make test-no-unix`) pp-cl, its tests and the programs that they
start lack what only Unix has; of the modules, other packages keep theirs.
"""

import asyncio  # noqa: F401, as it would not be imported later
import builtins
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys

MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "termios")
OURS = ("pp_cl", "tests", "support", "test_", "__main__")
ELSEWHERE = ("SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM")


def hiding(function):
    """An import that finds no MODULES for our own modules."""

    def found(name, *words, **more):
        if name in MODULES and sys._getframe(1).f_globals.get("__name__", "").startswith(OURS):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return function(name, *words, **more)

    return found


builtins.__import__ = hiding(builtins.__import__)
importlib.import_module = hiding(importlib.import_module)
for name in ("fork", "forkpty", "mkfifo", "killpg", "O_DIRECTORY"):
    delattr(os, name)
killing = signal.SIGKILL
subprocess.Popen.kill = lambda self: self.send_signal(killing)
for name, number in list(vars(signal).items()):
    if isinstance(number, signal.Signals) and name not in ELSEWHERE:
        delattr(signal, name)
multiprocessing.set_start_method("spawn", force=True)
