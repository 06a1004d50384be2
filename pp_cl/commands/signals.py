"""How Ctrl-C and SIGTERM stop a long command in good order."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

STOPPING = (signal.SIGINT, signal.SIGTERM)


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
        yield caught
    finally:
        restore()
