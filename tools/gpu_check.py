"""Compile and link every kernel as the drivers build it on GPUs, without a GPU.

    python -m tools.gpu_check                        # or make gpu-check
    python -m tools.gpu_check --targets sm_80,pvc    # other GPUs: only errors and local memory fail
    python -m tools.gpu_check --write                # write the table, shorten the known list

Fails on a build that does not compile or link, on more than 32 KiB of local memory, and on any
spill, private array, more than 128 registers and threads of 8 lanes that tools/gpu/known.json does
not have, or has without need. Exit status: 1 for these, 2 where a compiler is missing.
"""

import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from pp_cl import __version__
from pp_cl.device.device import kernel_folder
from tools.gpu.builds import Build, read_builds
from tools.gpu.compilers import BuildError, Usage, cached_build, version
from tools.gpu.known import (
    MOST_LOCAL,
    complaints,
    leftovers,
    news,
    read_known,
    shortened,
    write_known,
)
from tools.gpu.packages import CompilerMissing, unpack_missing

TARGETS = ("sm_90", "gfx1100", "dg2")
RESULTS = Path(__file__).parents[1] / "docs" / "results" / "gpu_check.json"
HEADS = {
    "sm_90": {"registers": "sm_90: registers", "spill": "spill, B", "private": "private, B"},
    "gfx1100": {"registers": "gfx1100: VGPRs", "spill": "spill", "private": "scratch, B"},
    "dg2": {"simd": "dg2: SIMD", "spill": "spill", "private": "private, B"},
}

Row = tuple[Build, str, str]  # build, kernel, target


def compile_all(
    compilers: dict[str, str], builds: dict[Build, set[str]], sources: Path
) -> tuple[dict[Row, Usage], list[str]]:
    """(what each launched kernel takes, a line for each build that failed). compilers: {target:
    versions of its compilers}.
    """

    def one(job):
        target, build = job
        try:
            return cached_build(target, build, sources, compilers[target])
        except BuildError as error:
            return error

    jobs = [(target, build) for target in compilers for build in sorted(builds)]
    usages, failed = {}, []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for (target, build), found in zip(jobs, pool.map(one, jobs), strict=True):
            if isinstance(found, BuildError):
                failed.append(f"{target} {build.label} does not build or link: {found}")
                continue
            for kernel in sorted(builds[build]):
                if kernel in found:
                    usages[build, kernel, target] = found[kernel]
                else:
                    failed.append(f"{target} {build.label}: its compiler does not name {kernel}")
    return usages, failed


def too_much_local(usages: dict[Row, Usage]) -> list[str]:
    """A line for each kernel with more local memory than every GPU has."""
    return [
        f"{_name(row)}: {usage.local} bytes of local memory; {MOST_LOCAL} are the most"
        for row, usage in usages.items()
        if usage.local > MOST_LOCAL
    ]


def all_complaints(usages: dict[Row, Usage]) -> dict[str, dict[str, int]]:
    """What is too much of each kernel, as tools/gpu/known.py has it."""
    found = {_name(row): complaints(usage) for row, usage in usages.items()}
    return {name: numbers for name, numbers in found.items() if numbers}


def _name(row):
    build, kernel, target = row
    return f"{target} {build.label}: {kernel}"


def results(usages: dict[Row, Usage], compilers: list[str]) -> dict:
    """docs/results/gpu_check.json: a row for each kernel of each build. Numbers that are 0 are left
    out.
    """
    rows = {}
    for (build, kernel, target), usage in sorted(usages.items()):
        row = rows.setdefault((build, kernel), {"build": build.label, "kernel": kernel})
        row |= {f"{target}_{name}": n for name, n in asdict(usage).items() if n}
    columns = [{"head": "build", "cell": "{build}"}, {"head": "kernel", "cell": "{kernel}"}]
    for target, heads in HEADS.items():
        columns += [{"head": h, "cell": f"{{{target}_{name}}}"} for name, h in heads.items()]
    return {
        "measured": f"what each kernel takes on GPUs, by {'; '.join(compilers)}",
        "version": __version__,
        "command": "python -m tools.gpu_check --write",
        "columns": columns,
        "rows": list(rows.values()),
    }


def print_table(usages: dict[Row, Usage]) -> None:
    """A line for each kernel of each build, with what is not 0."""
    lines = {}
    for (build, kernel, target), usage in sorted(usages.items()):
        numbers = ", ".join(f"{name} {n}" for name, n in asdict(usage).items() if n)
        lines.setdefault((build, kernel), []).append(f"{target}: {numbers}")
    for (build, kernel), texts in lines.items():
        print(f"{build.label}: {kernel}", *texts, sep="\n    ")


def usable(targets: list[str]) -> tuple[dict[str, str], list[str]]:
    """({target: its compilers}, a line for each target whose compiler is missing)."""
    problem = unpack_missing()
    found, missing = {}, []
    for target in targets:
        try:
            found[target] = version(target)
        except CompilerMissing as error:
            missing.append(f"{target} is not checked: {error}" + (f" ({problem})" * bool(problem)))
    return found, missing


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--targets", default=",".join(TARGETS), help="sm_*, gfx*, ocloc's names")
    parser.add_argument("--write", action="store_true", help="the table; shorten the known list")
    given = parser.parse_args(arguments)
    compilers, missing = usable(given.targets.split(","))
    usages, failed = compile_all(compilers, read_builds(), kernel_folder())
    judged = {row: usage for row, usage in usages.items() if row[2] in TARGETS}
    found = all_complaints(judged)
    targets = {target for _, _, target in judged}
    known = {name: n for name, n in read_known().items() if name.split()[0] in targets}
    print_table(usages)
    wrong = failed + too_much_local(usages) + news(found, known)
    if given.write and not failed and targets == set(TARGETS):
        text = json.dumps(results(judged, sorted(set(compilers.values()))), indent=1)
        RESULTS.write_text(f"{text}\n", "utf-8")
        write_known(shortened(found, known))
    else:
        wrong += [] if failed else leftovers(found, known)
    print(*wrong, *missing, sep="\n", file=sys.stderr)
    print(
        f"{len(usages)} kernels for {', '.join(compilers) or 'no target'}: {len(found)} known to"
        f" take too much, {len(wrong)} complaints",
        file=sys.stderr,
    )
    return 1 if wrong else 2 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
