"""Ctrl-C and SIGTERM end a command with one line, within seconds, and a training in good order."""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 3.0  # seconds after a signal until a process ends, whatever it is doing
INTERRUPTED = "interrupted"

# set once the line about the end of this process has been printed
told = threading.Event()
# cleared only while a training may end its step after a signal, however long that takes
_in_haste = threading.Event()
_in_haste.set()


@contextmanager
def interrupting() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM raise KeyboardInterrupt(number) in the block; yields a list of numbers."""
    caught: list[int] = []

    def interrupt(number: int, _frame: FrameType | None) -> None:
        caught.append(number)
        raise KeyboardInterrupt(number)

    with _handled_by(interrupt):
        yield caught


@contextmanager
def first_signal(*, in_haste: bool = False) -> Iterator[list[int]]:
    """Yields a list that is empty until Ctrl-C or SIGTERM comes and then holds its number. A second
    signal does what it did before the block. in_haste: the process ends PATIENCE seconds after the
    signal, not after the block.
    """
    caught: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        caught.append(number)
        restore()

    with _handled_by(note) as restore:
        if not in_haste:
            _in_haste.clear()
        try:
            yield caught
        finally:
            _in_haste.set()


@contextmanager
def deferred() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the block ends; processes that start in it get neither."""
    if sys.platform == "win32" or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _handled_by(handle: Callable[[int, FrameType | None], None]) -> Iterator[Callable[[], None]]:
    """Yields a function that restores the signals' handlers; in other threads nothing changes."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in STOPPING}
    # signals that nohup, or & in a script, ignores stay ignored; None: not a handler of Python's
    before = {n: handler for n, handler in before.items() if handler not in (signal.SIG_IGN, None)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    for number in before:
        signal.signal(number, handle)
    try:
        yield restore
    finally:
        restore()


def watch() -> None:
    """From now on, a signal with a handler ends this process PATIENCE seconds later, as handlers do
    not run while a driver's compiler works or while Python waits for a thread.
    """
    try:
        reader, writer = socket.socketpair()
    except OSError:  # no more files can be opened: only handlers act
        return
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

    def end(_open: socket.socket) -> None:
        [number] = reader.recv(1)
        _in_haste.wait()
        time.sleep(PATIENCE)
        if not told.is_set():
            os.write(2, f"pp-cl: {INTERRUPTED}\n".encode())
        os._exit(128 + number)

    threading.Thread(target=end, args=(writer,), daemon=True).start()
