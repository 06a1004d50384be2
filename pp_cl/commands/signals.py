"""How Ctrl-C and SIGTERM stop a command: at once, or in good order."""

import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STOPPING = (signal.SIGINT, signal.SIGTERM)
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
GRACE = 3.0  # seconds in which a command ends by itself

_unhurried = 0  # blocks of unhurried() that are entered


class Terminated(KeyboardInterrupt):
    """SIGTERM came."""


def number_of(error: KeyboardInterrupt) -> int:
    """The signal that was the reason."""
    return signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT


@contextmanager
def answered() -> Iterator[None]:
    """While it is entered, SIGTERM raises Terminated as Ctrl-C raises KeyboardInterrupt; and where
    that does not end the block, as in a long call of a library, the process ends after GRACE
    seconds, with its line and status. Whatever is written is written so that this does no harm.

    To be entered in the main thread, once in a process.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    ended = threading.Event()

    def watch():
        held(STOPPING)  # others take them
        while number := reader.recv(1):
            number = number[0]
            if number in STOPPING and not ended.wait(GRACE) and not _unhurried:
                os.write(2, f"pp-cl: {WORDS[number]}\n".encode())
                os._exit(128 + number)

    def terminated(*_):
        raise Terminated

    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:  # not ignored
        signal.signal(signal.SIGTERM, terminated)
    signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(-1)
        writer.close()


def held(numbers: tuple[int, ...]) -> set[int]:
    """Keep signals from this thread, and from threads and processes that it starts; returns those
    that were before, to be given to signal.pthread_sigmask(). Windows has none.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return set()
    return signal.pthread_sigmask(signal.SIG_BLOCK, numbers)


@contextmanager
def deferred() -> Iterator[None]:
    """Ctrl-C and SIGTERM are answered after the block."""
    before = held(STOPPING)
    try:
        yield
    finally:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def unhurried() -> Iterator[None]:
    """The block may take its time to end after a signal."""
    global _unhurried
    _unhurried += 1
    try:
        yield
    finally:
        _unhurried -= 1


@contextmanager
def first_signal() -> Iterator[list[int]]:
    """A list that is empty until Ctrl-C or SIGTERM comes, and then holds its number. A second one
    does what it did before. To be entered in the main thread.
    """
    caught = []
    before = {number: signal.getsignal(number) for number in STOPPING}
    # nohup, and & in a script, leave signals ignored; None is a handler that is not Python's
    before = {n: handler for n, handler in before.items() if handler not in (signal.SIG_IGN, None)}

    def restore():
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number, _frame):
        caught.append(number)
        restore()

    for number in before:
        signal.signal(number, note)
    try:
        with unhurried():
            yield caught
    finally:
        restore()
