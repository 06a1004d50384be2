"""The process that tries inputs: names come in on standard input, a line of JSON goes out each."""

import contextlib
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path
from random import Random

from tools.fuzz import runs, scenes, words
from tools.fuzz.judge import Case, Finding, stack
from tools.fuzz.templates import World

SURFACES = scenes.SURFACES | runs.SURFACES | words.SURFACES
LONGEST = 60  # seconds for an input
MEMORY = 8 * 2**30  # address space, bytes: PoCL takes some


class Hang(BaseException):
    """An input took longer than LONGEST. Not an Exception: readers turn those into messages."""


def try_input(world: World, name: str, seed: int) -> tuple[str, str, str]:
    """(label, finding or "", its traceback) of the input SURFACE:INDEX of a seed."""
    surface = name.partition(":")[0]
    folder = world.folder / "input"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    case = Case(Random(f"{seed}:{name}"), folder, world)  # noqa: S311  not for secrets
    try:
        signal.alarm(LONGEST)
        SURFACES[surface](case)
        found, detail = "", ""
    except Finding as finding:
        found, detail = str(finding), traceback.format_exc()
    except Hang as hang:
        found, detail = f"hang at {stack(hang)}", traceback.format_exc()
    except Exception as error:
        found, detail = f"{type(error).__name__} at {stack(error)}", traceback.format_exc()
    finally:
        signal.alarm(0)
    return case.label, found, detail


def _hang(*_):
    raise Hang


def main() -> None:
    """Try inputs until standard input ends. Arguments: the seed, a folder to work in, and one for
    inputs with findings or nothing.
    """
    seed, place, kept = int(sys.argv[1]), *sys.argv[2:]
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what commands print is no answer
    os.dup2(1, 2)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, _hang)
    with tempfile.TemporaryDirectory(dir=place) as folder:
        world = World(Path(folder))
        world.share_device()
        for line in sys.stdin:
            name = line.strip()
            label, found, detail = try_input(world, name, seed)
            if found and kept:
                target = Path(kept) / name.replace(":", "-")
                shutil.rmtree(target, ignore_errors=True)
                with contextlib.suppress(OSError, shutil.Error):
                    shutil.copytree(world.folder / "input", target, symlinks=True)
            answers.write(json.dumps({"label": label, "found": found, "detail": detail}) + "\n")


if __name__ == "__main__":
    main()
