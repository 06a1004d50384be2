"""`pp-cl sweep`: trains and measures many scenes, settings and seeds, and prints one table."""

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.config import PRESETS
from pp_cl.errors import Stopped, UserError

HELP = "train and measure scenes x settings x seeds, with one table; the same command resumes"
EPILOG = """\
Each run is a folder DIR/SCENE/[SETTING/]seed-S, as `pp-cl train` and `pp-cl eval` leave it, with
what its processes said beside it in seed-S.log. A run that is trained and measured is not run
again; one that was interrupted goes on from its checkpoint. The table is also in DIR/sweep.json and
DIR/sweep.md. Exit status: 0 all went well, 1 some runs failed, 2 nothing was run.

  pp-cl sweep lego chair --out sweeps/a --seeds 1,2,3 --vary points.count=100000,200000
  pp-cl sweep demo --out sweeps/b --vary network.widths=16,16,16/32,32,32 --set train.crop=128

With --scheduler the runs go to the workers of a Dask cluster, which must see SCENE and DIR under
the same paths. Who can reach a scheduler can run anything on its workers, so bind both to loopback,
or use Dask's certificates:

  dask scheduler --host 127.0.0.1
  PP_DEVICE=0:0 dask worker tcp://127.0.0.1:8786 --host 127.0.0.1 --nthreads 1
  pp-cl sweep lego --out sweeps/a --scheduler tcp://127.0.0.1:8786
"""
MOST_WORKERS = 256


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("scenes", nargs="+", metavar="SCENE", help="folder of a scene, or the word demo")
    add("--out", required=True, metavar="DIR", help="folder of the runs and the table")
    add(
        "--seeds",
        type=shared.several(shared.integer(0, 2**32 - 1)),
        default="0",
        metavar="A,B",
        help="one run for each (0)",
    )
    add("--preset", choices=PRESETS, help="as for `pp-cl train` (tiny)")
    add("--iterations", metavar="N", help="steps of each training")
    shared.add_set(parser, "a setting of all runs")
    add(
        "--vary",
        action="append",
        default=[],
        metavar="SECTION.KEY=A,B",
        help="one run for each value; / separates values that are lists; several --vary: every"
        " combination",
    )
    add(
        "--workers",
        type=shared.integer(1, MOST_WORKERS),
        metavar="N",
        help="runs at the same time (one on each GPU, else one)",
    )
    add("--scheduler", metavar="ADDRESS", help="a Dask cluster, instead of own workers")
    shared.add_metrics(parser)
    add("--dry-run", action="store_true", help="list the runs, start nothing")
    shared.add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run what is missing and print the table. Raises Stopped if runs failed."""
    from pp_cl import RunFolder
    from pp_cl.files import own
    from pp_studio.sweep import plan, table

    if options.scheduler and options.workers:
        raise UserError("--workers: the cluster of --scheduler has its own; leave one of both out")
    if options.dry_run and options.json:
        raise UserError("--json: a dry run measures nothing; leave one of both out")
    if RunFolder(options.out).config.exists():
        raise UserError(f"--out {options.out}: is the folder of a run; choose another")
    jobs = plan.plan(
        options.scenes,
        options.out,
        options.seeds,
        plan.read_varied(options.vary),
        given=[*shared.read_short(options, ["iterations"]), *options.set],
        preset_name=options.preset,
        metrics=options.metrics,
    )
    rows, states, out = {}, {}, Path(options.out)
    for job in jobs:
        states[job.folder] = "to go on" if RunFolder(job.folder).config.exists() else "to do"
        try:
            if row := table.finished_row(job):
                rows[job.folder], states[job.folder] = row, f"finished: {table.values_text(row)}"
        except UserError as error:  # the job raises it again and reports it in its row
            states[job.folder] = f"will fail: {error}"
    summary = f"{len(jobs)} runs, {len(rows)} of them finished already"
    if options.dry_run:
        for job in jobs:
            print(f"{table.run_text(table.failed_row(job, ''))}: {states[job.folder]}")
        print(f"{summary}; nothing was started")
        return
    print(summary, flush=True)
    missing = [job for job in jobs if job.folder not in rows]
    own(out, [out / name for name in table.TABLES])
    if missing:
        rows |= _run(options, missing, len(jobs))
    # store folders relative to `out`, which may be moved
    ordered = [
        rows[job.folder] | {"folder": Path(job.folder).relative_to(out.resolve()).as_posix()}
        for job in jobs
    ]
    shared.write_json_option(options.json, table.write_tables(out, ordered))
    print(table.markdown(ordered))
    print("wrote " + " and ".join(str(out / name) for name in table.TABLES))
    failed = sum("error" in row for row in ordered)
    if failed:
        raise Stopped(f"{failed} of {len(jobs)} runs failed; the same command tries them again", 1)


def _run(options, jobs, total):
    """Run the jobs, print a line as each ends; {folder: row}. Raises Stopped after a signal."""
    from pp_cl import separate_devices
    from pp_cl.commands.signals import first_signal
    from pp_cl.errors import require

    # the last one makes certificates
    require("pp-cl sweep", "dask", "distributed", "cryptography")
    from pp_studio.sweep.cluster import client_of, local_client, run_jobs
    from pp_studio.sweep.table import run_text, values_text

    rows, devices = {}, [] if options.scheduler else separate_devices()
    with ExitStack() as stack:
        caught = stack.enter_context(first_signal(in_haste=True))
        if options.scheduler:
            client = stack.enter_context(client_of(options.scheduler))
        else:
            workers = min(options.workers or len(devices), len(jobs))
            client = stack.enter_context(local_client(workers))
        for row in run_jobs(client, jobs, devices, lambda: bool(caught)):
            rows[row["folder"]] = row
            number = total - len(jobs) + len(rows)
            text = f"[{number} of {total}] {run_text(row)}: {values_text(row)}"
            print(text, file=sys.stderr, flush=True)
    if caught and any("error" in row for row in rows.values()):
        raise Stopped("stopped; the same command goes on", 128 + caught[0])
    return rows
