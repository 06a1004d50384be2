"""Runs the trainings of a sweep with Dask: on workers of this machine, or on a given scheduler."""

import asyncio
import logging
import math
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from datetime import datetime
from typing import Any

import dask
from distributed import Client, Event, LocalCluster, WorkerPlugin, get_worker
from tqdm import tqdm

from pp_cl import evaluate_run, train_scene
from pp_cl.errors import UserError, one_line
from pp_cl.scene import scene_splits
from pp_studio.sweep.plan import Job
from pp_studio.sweep.table import failed_row, finished_row

LOOPBACK = "127.0.0.1"
ANSWER = 20  # seconds that a scheduler, and then its first worker, have to answer
TICK = 0.5  # seconds between two looks at the runs
ENDING = 2.0  # seconds that trainings have to write their checkpoints when a sweep is stopped
SETTINGS = {
    "distributed.scheduler.worker-saturation": 1.0,  # a worker holds one run and queues none
    "distributed.nanny.pre-spawn-environ": {},  # Dask's default, one thread for numpy, is too few
}

# ---- on a worker


def run_task(job: Job, devices: Sequence[str], stop: str) -> dict[str, Any]:
    """Run a job in the Dask worker that calls this, and return its row. devices: indices of
    `pp-cl devices` that workers take in turn; empty: each worker uses its default. stop: name of
    the Event that ends the sweep.
    """
    # tqdm's own lock is shared by processes; a killed worker would leak it with a warning
    tqdm.set_lock(threading.RLock())
    device = devices[get_worker().name % len(devices)] if devices else None
    return run_job(job, device, Event(stop).is_set)


def run_job(job: Job, device: str | None, is_stopped: Callable[[], bool]) -> dict[str, Any]:
    """Do what is missing of a job's training and evaluation, and return its row; that of a failed
    job says why. Output is appended to the job's log.

    is_stopped: called before the first step and after each; if it returns True, the training writes
    a checkpoint and ends.
    """
    try:
        log = open(job.log, "a", buffering=1, encoding="utf-8")  # noqa: SIM115
    except OSError as error:
        why = f"{job.log}: {error.strerror} for process {os.getpid()}"
        return failed_row(job, f"{why}; all workers must see the same files")
    with log, redirect_stdout(log), redirect_stderr(log):
        try:
            log.write(f"{datetime.now():%Y-%m-%d %H:%M:%S} process {os.getpid()}\n")
            if is_stopped():
                return failed_row(job, "stopped")
            if row := finished_row(job):
                return row
            if "test" not in scene_splits(job.scene):
                raise UserError(f"{job.scene}: has no split test, which a sweep measures; add one")
            run = train_scene(
                job.scene,
                job.folder,
                job.preset or "tiny",  # by minutes, runs beside each other would differ
                device,
                settings={key: text for key, text, _ in job.given},
                is_stopped=is_stopped,
            )
            if not run.header["finished"]:
                return failed_row(job, "stopped")
            evaluate_run(run, "test", job.metrics)
            return finished_row(job) or failed_row(job, "its evaluation is not whole")
        except UserError as error:
            return failed_row(job, str(error))
        except Exception as error:
            traceback.print_exc()
            what = f"{type(error).__name__}: {one_line(error, 500)}"
            return failed_row(job, f"{what}; see {job.log}")


# ---- the cluster


class Deaf(WorkerPlugin):
    """Makes workers ignore Ctrl-C, which a terminal sends to all processes."""

    def setup(self, worker: object) -> None:
        """Ignore SIGINT."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Dask with `workers` worker processes on this machine. They listen only on the loopback
    address, and answer only holders of this cluster's certificate. Raises UserError if they do not
    start.
    """
    with dask.config.set(SETTINGS):
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=0,
                host=LOOPBACK,
                security=True,
                dashboard_address=f"{LOOPBACK}:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
        except (OSError, RuntimeError) as error:
            raise UserError(
                f"the workers do not start ({error.__cause__ or error}); lower --workers, or raise"
                " the limits of this shell (ulimit -a)"
            ) from error
        with cluster, Client(cluster) as client:
            client.register_plugin(Deaf())
            yield client


@contextmanager
def client_of(address: str) -> Iterator[Client]:
    """Dask with the scheduler at an address. Raises UserError if no scheduler with workers answers
    there, or if its workers run several tasks at once.
    """
    why = f"--scheduler {address}: "
    with ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=ANSWER))
            client.wait_for_workers(1, timeout=ANSWER)
        except (OSError, ValueError, asyncio.TimeoutError) as error:
            reason = one_line(error, 500) or type(error).__name__
            why += f"no Dask scheduler with workers answers ({reason}); start both"
            raise UserError(f"{why} as `pp-cl sweep --help` says") from None
        if max(client.nthreads().values()) > 1:
            raise UserError(f"{why}a worker would train several runs at once; use --nthreads 1")
        yield client


def run_jobs(
    client: Client, jobs: Sequence[Job], devices: Sequence[str], is_stopped: Callable[[], bool]
) -> Iterator[dict[str, Any]]:
    """Yield the row of each job as it ends. devices: see run_task(). Once is_stopped() is True,
    trainings write their checkpoints and end, and their rows say so; jobs still running ENDING
    seconds later are left alone.
    """
    for job in jobs:
        job.log.parent.mkdir(parents=True, exist_ok=True)
    stop = Event(client=client)
    pending = {client.submit(run_task, job, devices, stop.name, pure=False): job for job in jobs}
    until = math.inf
    while pending and time.monotonic() < until:
        if until == math.inf and is_stopped():
            stop.set()
            until = time.monotonic() + ENDING
        for future in [future for future in pending if future.done()]:
            job = pending.pop(future)
            if future.status == "finished":
                yield future.result()
            elif future.status == "error":  # its workers have died
                yield failed_row(job, f"{one_line(future.exception(), 500)}; see {job.log}")
            else:
                yield failed_row(job, "the scheduler is gone; the same command goes on")
        time.sleep(TICK)
    for job in pending.values():
        yield failed_row(job, "stopped")
