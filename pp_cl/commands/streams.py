"""Standard streams as a shell may give them: closed, full, without a reader, of an encoding that
lacks letters. None of this is a fault of the program, nor a reason for another exit status.
"""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import TextIO


@contextmanager
def usable_streams() -> Iterator[None]:
    """While the block runs, a closed stream is the null device, and a letter that a stream's
    encoding lacks is written as an escape. At its end nothing is left to be written.
    """
    redirections = {"stdout": redirect_stdout, "stderr": redirect_stderr}
    with ExitStack() as stack:
        for name, redirect in redirections.items():
            stream = getattr(sys, name)
            if stream is None:  # closed before Python began
                null = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
                stack.enter_context(redirect(null))
            elif isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        try:
            yield
        finally:
            for name in redirections:
                _finish(getattr(sys, name))


def _finish(stream: TextIO):
    """Write what a stream still holds. Where that fails it goes nowhere, or Python would try again
    when it ends, and report that.
    """
    try:
        stream.flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)
