"""Read damaged and odd input on every surface where pp-cl reads what others wrote.

    python -m tools.fuzz --count 20000 --seed 1     # or make fuzz COUNT=20000 SEED=1
    python -m tools.fuzz --surfaces config,log      # some
    python -m tools.fuzz --one config:317 --seed 1  # one input again, with its traceback

Inputs are functions of (seed, surface, index). Right is an input that is taken and sound, or
refused in one line with exit status 2. A traceback, a crash, a hang, a lack of memory, NaN and
nonsense that is believed are findings: then the exit status is 1.
"""

import argparse
import json
import math
import os
import select
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from tools.fuzz.worker import LONGEST, SURFACES

GRACE = 30  # seconds more that a worker has to answer, the first time with its templates to make
START = 180
# share of an input's surface among all, where it is not 1: the larger, the more it can find
SHARES = {"transforms": 4, "images": 4, "checkpoint": 4, "config": 3, "settings": 2, "mesh": 2}
SHARES |= {"command_line": 0.5, "environment": 0.3, "lpips": 0.3}


class Worker:
    """A process of tools/fuzz/worker.py, started anew when it dies or hangs."""

    def __init__(self, seed: int, folder: str, kept: str) -> None:
        self._words = [sys.executable, "-m", "tools.fuzz.worker", str(seed), folder, kept]
        self._process = None

    def try_input(self, name: str) -> dict:
        """What the worker answers; a crash or hang of it is a finding, too."""
        patience = LONGEST + GRACE
        if self._process is None:
            patience += START
            self._process = subprocess.Popen(
                self._words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        process = self._process
        try:
            process.stdin.write(f"{name}\n")
            process.stdin.flush()
            ready = select.select([process.stdout], [], [], patience)[0]
            line = process.stdout.readline() if ready else ""
        except BrokenPipeError:
            ready, line = True, ""
        if line:
            return json.loads(line)
        self.end()
        found = (
            f"crash with exit status {process.returncode}" if ready else "hang outside of Python"
        )
        return {"label": "", "found": found, "detail": ""}

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.stdin.close()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None


def names_of(surfaces: Iterable[str], count: int) -> list[str]:
    """Names SURFACE:INDEX of so many inputs, by SHARES, each surface at least once, all mixed."""
    shares = {surface: SHARES.get(surface, 1) for surface in surfaces}
    total = sum(shares.values())
    counts = {surface: max(1, round(count * share / total)) for surface, share in shares.items()}
    inputs = [(i / n, surface, i) for surface, n in counts.items() for i in range(n)]
    return [f"{surface}:{index}" for _, surface, index in sorted(inputs)]


def try_all(
    names: list[str], seed: int, kept: str = "", seconds: float = math.inf
) -> tuple[dict[str, int], dict]:
    """({surface: inputs tried}, {finding: [(name, label, traceback)]}) of inputs, on all cores, as
    far as they are tried in so many seconds.
    """
    left, tried, findings, lock = iter(names), {}, {}, threading.Lock()
    last = time.monotonic() + seconds

    def work(folder):
        worker = Worker(seed, folder, kept)
        while time.monotonic() < last:
            with lock:
                name = next(left, None)
            if name is None:
                break
            answer = worker.try_input(name)
            surface = name.partition(":")[0]
            with lock:
                tried[surface] = tried.get(surface, 0) + 1
                if answer["found"]:
                    key = f"{surface}: {answer['found']}"
                    findings.setdefault(key, []).append((name, answer["label"], answer["detail"]))
        worker.end()

    with tempfile.TemporaryDirectory(prefix="pp-cl-fuzz-") as folder:
        count = min(os.cpu_count(), len(names))
        workers = [threading.Thread(target=work, args=(folder,)) for _ in range(count)]
        for thread in workers:
            thread.start()
        for thread in workers:
            thread.join()
    return tried, findings


def report(tried: dict[str, int], findings: dict, seconds: float, *, details: bool) -> str:
    """The counts and the findings, one of each kind."""
    lines = []
    for key, found in sorted(findings.items(), key=lambda pair: -len(pair[1])):
        name, label, detail = found[0]
        lines.append(f"{len(found)} x {key}\n    e.g. --one {name} ({label})")
        lines += [detail] if details else []
    counts = ", ".join(f"{surface} {n}" for surface, n in sorted(tried.items()))
    total = sum(tried.values())
    lines.append(f"{total} inputs in {seconds:.0f} s: {counts}")
    lines.append(f"{len(findings)} kinds of findings")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=20_000, help="inputs (20000)")
    parser.add_argument("--seed", type=int, default=0, help="of all inputs (0)")
    parser.add_argument("--minutes", type=float, default=math.inf, help="end after so many")
    parser.add_argument("--surfaces", metavar="A,B", help=f"of {', '.join(SURFACES)}")
    parser.add_argument("--one", metavar="SURFACE:INDEX", help="one input again")
    parser.add_argument(
        "--keep", metavar="FOLDER", default="", help="copy inputs with findings there"
    )
    options = parser.parse_args(arguments)
    surfaces = options.surfaces.split(",") if options.surfaces else list(SURFACES)
    names = [options.one] if options.one else names_of(surfaces, options.count)
    unknown = {name.partition(":")[0] for name in names} - set(SURFACES)
    if unknown:
        parser.error(f"no surface {min(unknown)}; there are {', '.join(SURFACES)}")
    start = time.monotonic()
    kept = options.keep and str(Path(options.keep).resolve())
    tried, findings = try_all(names, options.seed, kept, 60 * options.minutes)
    print(report(tried, findings, time.monotonic() - start, details=bool(options.one)))
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
