"""How Ctrl-C and SIGTERM end a command: with one line, within seconds, a training in good order."""

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

# the line about the end of this process was printed
told = threading.Event()
# set but while a training may end its step after a signal, however long that takes
_in_haste = threading.Event()
_in_haste.set()


@contextmanager
def interrupting() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM raise KeyboardInterrupt(number) in the block; a list of what came."""
    caught: list[int] = []

    def interrupt(number: int, _frame: FrameType | None) -> None:
        caught.append(number)
        raise KeyboardInterrupt(number)

    with _handled_by(interrupt):
        yield caught


@contextmanager
def first_signal(*, in_haste: bool = False) -> Iterator[list[int]]:
    """A list that is empty until Ctrl-C or SIGTERM comes, and then holds its number. A second one
    does what it did before. in_haste: the process ends PATIENCE seconds later, not so long after.
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
    """Ctrl-C and SIGTERM are answered after the block; processes that start in it get none."""
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
    """Gives what makes signals do again what they did before; in other threads nothing changes."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in STOPPING}
    # nohup, and & in a script, leave signals ignored; None is a handler that is not Python's
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
    """From now on a signal that is handled ends this process PATIENCE seconds later: handlers do
    not run while a driver's compiler or a thread that is waited for takes its time.
    """
    try:
        reader, writer = socket.socketpair()
    except OSError:  # no file may be opened any more: handlers alone
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
