"""A run as a task of Dask: a process of its own, watched by the worker that has the task."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from pp_cl.errors import UserError
from pp_cl.files.atomic import mend
from pp_cl.sweep.plan import Job
from pp_cl.sweep.result import failed_row, finished_row

COMMAND = [sys.executable, "-m", "pp_cl.sweep.child"]
POLL = 0.2  # seconds between two looks at the process and at the task


def run_task(job: Job) -> dict[str, Any]:
    """The row of a job, run by the Dask worker that calls this; a failed one says why."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def is_wanted():
        """Dask ends no thread, but notes in the worker that nobody waits for its task."""
        task = worker.state.tasks.get(key)
        return task is not None and task.state not in ("cancelled", "released", "forgotten")

    return supervise(job, is_wanted, str(worker.name))


def supervise(job: Job, is_wanted: Callable[[], bool], worker: str) -> dict[str, Any]:
    """The row of a job, run by a process of its own, which ends with a checkpoint as soon as
    is_wanted() is false or this process is gone. worker: its name, for the log.
    """
    if not job.log.parent.is_dir():
        return failed_row(
            job, f"{job.log.parent}: not there for worker {worker}; all must see the same files"
        )
    # unbuffered: a failed write leaves nothing that closing would try to write again
    with open(job.log, "ab", buffering=0) as log:
        now = f"{datetime.now():%Y-%m-%d %H:%M:%S}"
        try:
            log.write(f"{now} on worker {worker}, process {os.getpid()}\n".encode())
        except OSError as error:
            problem = f"cannot be written ({error.strerror}); {mend(error)}"
            return failed_row(job, f"{job.log}: {problem}")
        begin = log.tell()
        process = subprocess.Popen(
            COMMAND, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT
        )
        wanted = _await_end(process, job, is_wanted)
    try:
        row = finished_row(job)
    except UserError as error:
        return failed_row(job, str(error))
    if row and process.returncode == 0:
        return row
    return failed_row(job, _reason(job, process.returncode, begin) if wanted else "stopped")


def _await_end(process, job, is_wanted):
    """Hand the job over and wait; returns whether it was wanted until the process ended."""
    try:
        process.stdin.write(job.to_json().encode() + b"\n")
        process.stdin.flush()
        while process.poll() is None:
            if not is_wanted():
                return False
            time.sleep(POLL)
    except OSError:
        pass  # it ended before it read; the log says why
    finally:
        with suppress(OSError):
            process.stdin.close()
        process.wait()
    return True


def _reason(job, status, begin):
    """Why the process ended, in one line, by what it has said since byte `begin` of the log."""
    with open(job.log, "rb") as log:
        log.seek(begin)
        said = log.read().decode("utf-8", "replace")
    if status < 0:
        return f"its process was ended by signal {-status}; see {job.log}"
    if status == 0:
        return "its process was stopped; the same command goes on"
    lines = [line for line in said.splitlines() if line.strip()] or ["nothing was said"]
    return f"{lines[-1]}; see {job.log}" if "Traceback" in said else lines[-1]


def prepare(jobs: list[Job]) -> None:
    """Make the folders of the jobs' logs."""
    for folder in {job.log.parent for job in jobs}:
        Path(folder).mkdir(parents=True, exist_ok=True)
