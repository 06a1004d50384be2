"""Inject faults into trainings and evaluations, and look at what they leave.

    python -m tools.faults                        # or make faults
    python -m tools.faults --only calls,kills --kills 50
    python -m tools.faults --write                # write the table of docs/reliability.md

Every call that changes a file of the run is made to fail, one by one; processes are killed and
stopped; disks are full or read-only, scenes lost, clocks wrong. After each fault there must be one
line on stderr and exit status 2, or nothing wrong at all; no file under a final name may be half
written; the next start must go on, to the bytes of an undisturbed run. Needs Linux and cc. Exit
status: 1 where something was found, 2 where it cannot run.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pp_cl import __version__
from pp_cl.device.discover import open_device
from pp_cl.scene.demo import demo_scene, write_scene
from tools.injection.bench import Bench, Tally
from tools.injection.scenarios import SCENARIOS
from tools.injection.trial import SIZE, VIEWS
from tools.injection.worker import ROOT, build_shim

RESULTS = ROOT / "docs" / "results" / "faults.json"
SIDE_BY_SIDE = 2
HEADS = {
    "fault": "{fault}",
    "cases": "{tried}",
    "ended by it": "{stopped}",
    "went on": "{went_on}",
    "findings": "{found}",
}


@contextmanager
def opened_bench(folder: Path, places: int = SIDE_BY_SIDE, **numbers: int) -> Iterator[Bench]:
    """A Bench with a scene of its own, all below `folder`. numbers: fields of it. Raises OSError or
    CalledProcessError where the shim cannot be compiled.
    """
    library = build_shim(ROOT / "build" / "faults")
    write_scene(demo_scene(open_device(), size=SIZE, most=VIEWS), folder / "scene")
    bench = Bench(folder / "scene", library, folder, places, **numbers)
    try:
        yield bench
    finally:
        bench.close()


def run_all(bench: Bench, names: list[str]) -> tuple[list[Tally], list[str]]:
    """(tallies, a line for each scenario that this system does not allow); tells of each."""
    tallies, skipped = [], []
    for name in names:
        start = time.perf_counter()
        try:
            for tally in SCENARIOS[name](bench):
                tallies.append(tally)
                print(
                    f"{tally.fault}: {tally.tried} cases, {tally.stopped} ended by it,"
                    f" {tally.went_on} went on, {len(tally.findings)} findings"
                    f" ({time.perf_counter() - start:.0f} s)",
                    *tally.findings,
                    sep="\n    ",
                    flush=True,
                )
                start = time.perf_counter()
        except subprocess.CalledProcessError as error:
            skipped.append(f"{name}: skipped, `{error.cmd[0]}` is not allowed here")
            print(skipped[-1], flush=True)
    return tallies, skipped


def results(tallies: list[Tally]) -> dict:
    """docs/results/faults.json."""
    rows = [
        {name: getattr(tally, name) for name in ("fault", "tried", "stopped", "went_on")}
        | {"found": len(tally.findings)}
        for tally in tallies
    ]
    return {
        "measured": "what became of trainings of 60 steps and of evaluations with a fault each",
        "version": __version__,
        "command": "python -m tools.faults --write",
        "columns": [{"head": head, "cell": text} for head, text in HEADS.items()],
        "rows": rows,
    }


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("--only", default=",".join(SCENARIOS), help="scenarios, separated by commas (all)")
    add("--kills", type=int, default=200, help="SIGKILLs of trainings; a fifth more of evaluations")
    add("--stops", type=int, default=10, help="of each kind of signal, and of two writers")
    add("--seed", type=int, default=0, help="of the random moments")
    add("--write", action="store_true", help="docs/results/faults.json, where all was tried")
    given = parser.parse_args(arguments)
    names = given.only.split(",")
    if unknown := set(names) - set(SCENARIOS):
        parser.error(f"no scenario {min(unknown)}; there are {', '.join(SCENARIOS)}")
    numbers = {"kills": given.kills, "stops": given.stops, "seed": given.seed}
    try:
        with (
            tempfile.TemporaryDirectory(prefix="faults-") as folder,
            opened_bench(Path(folder).resolve(), **numbers) as bench,
        ):
            tallies, skipped = run_all(bench, names)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"faults: cannot run ({error}); it needs Linux and cc", file=sys.stderr)
        return 2
    found = sum(len(tally.findings) for tally in tallies)
    print(f"{sum(tally.tried for tally in tallies)} cases, {found} findings")
    if given.write and not skipped and set(names) == set(SCENARIOS):
        RESULTS.write_text(json.dumps(results(tallies), indent=1) + "\n", "utf-8")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
