"""Runs the trainings of a sweep with Dask: on workers of this machine, or on a given scheduler."""

import asyncio
import logging
import os
import signal
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import datetime
from typing import Any

from tqdm import tqdm

from pp_cl.device.discover import open_device
from pp_cl.errors import UserError, one_line
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import evaluate, load_run
from pp_cl.scene.load import scene_splits
from pp_cl.session import is_finished, open_training, run_config, stored_state
from pp_cl.sweep.plan import Job
from pp_cl.sweep.result import failed_row, finished_row

try:
    import dask
    from cryptography import x509  # noqa: F401 what Dask makes certificates with
    from distributed import Client, Nanny, Scheduler, Security, SpecCluster, WorkerPlugin
    from distributed import get_worker as dask_worker
    from distributed.scheduler import KilledWorker
except ImportError as error:
    raise UserError(
        f"pp-cl sweep needs Dask ({error.name} is missing); install it with"
        " `pip install dask distributed cryptography`"
    ) from None

LOOPBACK = "127.0.0.1"
ANSWER = 20  # seconds that a scheduler, and its first worker, have to answer
TICK = 0.5  # seconds between two looks at the runs
PATIENCE = 600  # seconds that trainings have to write their checkpoints when the sweep is stopped

# ---- on a worker


def run_task(job: Job) -> dict[str, Any]:
    """The row of a job, trained and evaluated by the Dask worker that calls this."""
    # its own is shared between processes, and a worker that is killed would leak it with a warning
    tqdm.set_lock(threading.RLock())
    worker = dask_worker()
    key = worker.get_current_task()

    def is_cancelled():
        """Dask ends no thread, but notes in the worker that nobody waits for its task."""
        task = worker.state.tasks.get(key)
        return task is None or task.state in ("cancelled", "released", "forgotten")

    return run_job(job, is_cancelled, str(worker.name))


def run_job(job: Job, is_stopped: Callable[[], bool], worker: str) -> dict[str, Any]:
    """The row of a job, trained and evaluated as far as it is not; a failed one says why.

    is_stopped: asked after each step; where it is true, the training ends with a checkpoint.
    worker: its name, for the job's log, which gets what is printed meanwhile.
    """
    if not job.log.parent.is_dir():
        return failed_row(
            job, f"{job.log.parent}: not there for worker {worker}; all must see the same files"
        )
    try:
        with _printing_to(job.log) as log:
            now = f"{datetime.now():%Y-%m-%d %H:%M:%S}"
            print(f"{now} on worker {worker}, process {os.getpid()}", file=log)
            try:
                return _trained_and_evaluated(job, is_stopped)
            except Exception:
                traceback.print_exc(file=log)
                raise
    except UserError as error:
        return failed_row(job, str(error))
    except OSError as error:
        what = f"{error.filename or job.log}: {error.strerror or error}"
        return failed_row(job, f"{what}; check the disk")
    except MemoryError:
        return failed_row(
            job, "the host has no memory left; lower points.count or raise scene.downscale"
        )


@contextmanager
def _printing_to(log):
    """While the block runs, standard output and error of this process are appended to a file, which
    it is given.
    """
    with open(log, "a", buffering=1, encoding="utf-8") as file:
        kept = [os.dup(number) for number in (1, 2)]
        try:
            for number in (1, 2):
                os.dup2(file.fileno(), number)
            yield file
        finally:
            for number, before in zip((1, 2), kept, strict=True):
                os.dup2(before, number)
                os.close(before)


def _trained_and_evaluated(job, is_stopped):
    """The row of the job. Raises UserError as training and evaluation do."""
    if row := finished_row(job):
        return row
    if "test" not in scene_splits(job.scene):
        raise UserError(f"{job.scene}: has no split test, which a sweep measures; add one")
    folder, dev = RunFolder(job.folder), open_device()
    config = run_config(folder, job.scene, job.preset, job.given)
    stored = stored_state(folder, config)
    if not is_finished(stored, config):
        training = open_training(dev, folder, config, stored)
        training.run(is_stopped=is_stopped)
        if training.trainer.step < config.train.iterations:
            return failed_row(job, "stopped")
    evaluate(load_run(dev, job.folder), "test", job.metrics)
    return finished_row(job)


# ---- the cluster


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
        try:
            cluster = SpecCluster(
                specs, scheduler, security=security, silence_logs=logging.CRITICAL
            )
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
    on_tick: Callable[[list[Job]], None],
    is_stopped: Callable[[], bool],
) -> None:
    """Run the jobs. on_row(job, row) is called for each that ends, on_tick(jobs at work) now and
    then. Where is_stopped() is true, trainings write their checkpoints and end.
    """
    for job in jobs:
        job.log.parent.mkdir(parents=True, exist_ok=True)
    sweep = uuid.uuid4().hex  # keys of their own: a scheduler may have those of another sweep
    pending = {
        client.submit(run_task, job, key=f"pp-cl-{sweep}-{i}", pure=False): job
        for i, job in enumerate(jobs)
    }
    while pending and not is_stopped():
        for future in [future for future in pending if future.done()]:
            job = pending.pop(future)
            on_row(job, _row(future, job))
        running = _running(client)
        on_tick([job for future, job in pending.items() if future.key in running])
        time.sleep(TICK)
    running = _running(client)
    stopped = [job for future, job in pending.items() if future.key in running]
    client.cancel(list(pending))
    _await_ends(stopped)


def _running(client):
    """The keys of the tasks that workers have; none where the scheduler does not answer."""
    try:
        return {key for keys in client.processing().values() for key in keys}
    except (OSError, asyncio.TimeoutError):
        return set()


def _row(future, job):
    """The row of a task that has ended."""
    if future.status == "finished":
        return future.result()
    if future.status != "error":
        return failed_row(job, "the scheduler is gone; the same command goes on")
    error = future.exception()
    if isinstance(error, KilledWorker):
        return failed_row(job, f"several workers ended while they had this run; see {job.log}")
    return failed_row(job, f"{type(error).__name__}: {one_line(error, 200)}; see {job.log}")


def _await_ends(jobs):
    """Wait, at most PATIENCE seconds, until nobody trains into the folders of the jobs."""
    last = time.monotonic() + PATIENCE
    for job in jobs:
        while time.monotonic() < last:
            try:
                with RunFolder(job.folder).owned():
                    break
            except UserError:
                time.sleep(TICK)
