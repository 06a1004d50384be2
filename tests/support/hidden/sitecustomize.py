"""With this folder in PYTHONPATH (`make test-no-unix`) pp-cl, its tests and the programs that they
start lack what only Unix has; of the modules, other packages keep theirs.
"""

import asyncio  # noqa: F401, as it would not be imported later
import builtins
import functools
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
killing, kill, send = signal.SIGKILL, os.kill, subprocess.Popen.send_signal


def ending(process, number):
    """os.kill(), which ends processes as Windows does: no handler is asked."""
    if number and process == os.getpid():
        os._exit(number)
    kill(process, number and killing)


def sending(process, number):
    """Popen.send_signal(), which knows one signal there."""
    if number != signal.SIGTERM:
        raise ValueError(f"Unsupported signal: {number}")
    send(process, killing)


def starting(*words, real=subprocess.Popen._execute_child, **more):
    """What Popen.__init__() calls, with preexec_fn as the third after self; of our own modules."""
    if words[3] and sys._getframe(2).f_globals.get("__name__", "").startswith(OURS):
        raise ValueError("preexec_fn is not supported on Windows platforms")
    return real(*words, **more)


os.kill, os.getppid = ending, functools.partial(int, os.getppid())
subprocess.Popen._execute_child = starting
subprocess.Popen.send_signal = sending
subprocess.Popen.terminate = subprocess.Popen.kill = lambda self: send(self, killing)
for name, number in list(vars(signal).items()):
    if isinstance(number, signal.Signals) and name not in ELSEWHERE:
        delattr(signal, name)
multiprocessing.set_start_method("spawn", force=True)
