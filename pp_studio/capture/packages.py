"""Imports the packages of the extra `capture` when needed, and runs pycolmap in its own process."""

import importlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from types import ModuleType
from typing import Any

from PIL import Image  # noqa: F401  before pycolmap, whose zlib would otherwise be taken for Pillow's

from pp_cl.commands.signals import deferred
from pp_cl.errors import UserError

DISTRIBUTIONS = {
    "pycolmap": "pycolmap",
    "cv2": "opencv-python-headless",
    "pillow_heif": "pillow-heif",
    "imageio_ffmpeg": "imageio-ffmpeg",
}


def needed(module: str) -> ModuleType:
    """The imported module. Raises UserError with the command that installs it if it is missing."""
    is_here = module in sys.modules or threading.current_thread() is not threading.main_thread()
    try:
        if is_here:
            return importlib.import_module(module)
        answer = signal.getsignal(signal.SIGTERM)
        with deferred():
            try:
                return importlib.import_module(module)
            finally:  # pycolmap would otherwise answer SIGTERM itself, with a stack trace
                signal.signal(signal.SIGTERM, answer)
    except ImportError as error:
        raise UserError(
            f"capture needs the package {DISTRIBUTIONS[module]} ({error});"
            f" install what it needs with `pip install {' '.join(DISTRIBUTIONS.values())}`"
        ) from None


def isolated(folder: Path, function: Callable, *arguments: Any) -> Any:
    """Run a function in a separate process and return its result, since pycolmap's threads end
    their process when the disk is full. Raises UserError naming the folder if that happens.
    """
    needed("pycolmap")
    before = active_children()
    with ProcessPoolExecutor(1, get_context("spawn"), _begin) as pool:
        try:
            with deferred():
                future = pool.submit(function, *arguments)
            return future.result()
        except KeyboardInterrupt:  # the pool would wait until the function ends
            for process in {*active_children()} - {*before}:
                process.kill()
            raise
        except BrokenProcessPool:
            raise UserError(
                f"{folder}: pycolmap ended in the middle of its work; free some space on the disk,"
                " or some memory: the same command goes on"
            ) from None


def _begin():
    """Let the process end with its parent, which alone answers signals; only Python may write to
    stderr.
    """
    # NumPy's threads and ours would wait for each other, for long on a busy machine
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.filterwarnings("ignore", module=r"PIL\.")  # as pp_cl.files does: of large photographs
    sys.stderr = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)

    def watch():
        parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
