"""Runs of a sweep shared out by Dask: to workers on this machine, or to a scheduler's."""

import asyncio
import logging
import signal
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from pp_cl.errors import UserError, one_line
from pp_cl.sweep.plan import Job
from pp_cl.sweep.result import failed_row
from pp_cl.sweep.task import run_task

try:
    import dask
    from cryptography import x509  # noqa: F401 what Dask makes certificates with
    from distributed import Client, Nanny, Scheduler, Security, SpecCluster, WorkerPlugin
    from distributed.scheduler import KilledWorker
    from filelock import FileLock, Timeout
except ImportError as error:
    raise UserError(
        f"pp-cl sweep needs Dask ({error.name} is missing); install it with"
        " `pip install 'pp-cl[sweep]'`"
    ) from None

LOOPBACK = "127.0.0.1"
ANSWER = 20  # seconds that a scheduler, and its first worker, have to answer
TICK = 0.2  # seconds between two looks at the runs


class _Deaf(WorkerPlugin):
    """Workers that leave Ctrl-C, which reaches all processes of a terminal, to the sweep."""

    name = "pp-cl-deaf"

    def setup(self, worker):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def local_client(devices: Sequence[str], workers: int) -> Iterator[Client]:
    """Dask with `workers` processes on this machine, which take the devices in turn, as indices of
    `pp-cl devices`. They listen on the loopback address alone, and only who has the certificate of
    this very cluster can talk to them. Raises UserError where they do not start.
    """
    security = Security.temporary()
    place = {
        "host": LOOPBACK,
        "protocol": "tls://",
        "security": security,
        "dashboard": False,
        "dashboard_address": f"{LOOPBACK}:0",  # of the page that says "health", without dashboard
    }
    nanny = place | {"nthreads": 1, "memory_limit": 0, "plugins": (_Deaf(),)}
    nanny["silence_logs"] = logging.CRITICAL
    specs = {
        i: {"cls": Nanny, "options": nanny | {"env": {"PP_DEVICE": devices[i % len(devices)]}}}
        for i in range(workers)
    }
    settings = {
        "distributed.scheduler.worker-saturation": 1.0,  # a worker has its one run, none in line
        "distributed.nanny.pre-spawn-environ": {},  # one thread for numpy is not for trainings
    }
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        scheduler = {"cls": Scheduler, "options": place | {"port": 0}}
        silent = {"silence_logs": logging.CRITICAL}
        try:
            cluster = SpecCluster(specs, scheduler, security=security, **silent)
            client = Client(stack.enter_context(cluster))
        except (OSError, RuntimeError) as error:
            raise UserError(
                f"the workers do not start ({_root(error)}); lower --workers, or raise the limits"
                " of this shell (ulimit -a)"
            ) from error
        yield stack.enter_context(client)


def _root(error):
    """The error that began a chain of them."""
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__
    return one_line(error)


@contextmanager
def client_of(address: str) -> Iterator[Client]:
    """Dask whose scheduler is at an address. Raises UserError if nobody answers there, or if its
    workers run several tasks at once.
    """
    try:
        client = Client(address, timeout=ANSWER)
    except (OSError, ValueError, asyncio.TimeoutError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"--scheduler {address}: no Dask scheduler answers ({reason}); start one with"
            " `dask scheduler --host 127.0.0.1`"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER)
        except asyncio.TimeoutError:
            raise UserError(
                f"--scheduler {address}: has no workers; start one for each device with"
                f" `PP_DEVICE=0:0 dask worker {address} --nthreads 1`"
            ) from None
        for worker, threads in client.nthreads().items():
            if threads != 1:
                raise UserError(
                    f"--scheduler {address}: the worker {worker} would train {threads} runs at"
                    " once; start workers with --nthreads 1"
                )
        yield client


def run_jobs(
    client: Client,
    jobs: Sequence[Job],
    *,
    on_row: Callable[[Job, dict[str, Any]], None],
    on_tick: Callable[[], None],
    is_stopped: Callable[[], bool],
) -> None:
    """Run the jobs, their folders' parents being there; on_row(job, row) is called for each that
    ends, on_tick() now and then. Where is_stopped() is true, the trainings are told to end.
    """
    sweep = uuid.uuid4().hex  # keys of their own: a scheduler may have those of another sweep
    pending = {
        client.submit(run_task, job, key=f"pp-cl-{sweep}-{i}", pure=False): job
        for i, job in enumerate(jobs)
    }
    while pending and not is_stopped():
        for future in [future for future in pending if future.done()]:
            job = pending.pop(future)
            on_row(job, _row(future, job))
            future.release()
        on_tick()
        time.sleep(TICK)
    client.cancel(list(pending))


def _row(future, job):
    """The row of a task that has ended."""
    if future.status == "finished":
        return future.result()
    if future.status != "error":
        return failed_row(job, "the scheduler is gone; the same command goes on")
    error = future.exception()
    if isinstance(error, KilledWorker):
        return failed_row(job, f"several workers ended while they had this run; see {job.log}")
    return failed_row(job, f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}")


def await_ends(jobs: Sequence[Job], seconds: float) -> list[Job]:
    """Wait until no process works in the folders of the jobs; returns those where one still does
    after so many seconds.
    """
    last, left = time.monotonic() + seconds, []
    for job in jobs:
        if job.lock.exists():
            try:
                with FileLock(job.lock, timeout=max(last - time.monotonic(), 0)):
                    pass
            except Timeout:
                left.append(job)
    return left
