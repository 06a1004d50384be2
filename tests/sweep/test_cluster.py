"""Dask as a sweep uses it: who listens where, and what it says of tasks that fail."""

import errno
import importlib
import os
import signal
import sys
from types import SimpleNamespace

import psutil
import pytest
from distributed.scheduler import KilledWorker
from filelock import FileLock
from support.sweeps import jobs_of

from pp_cl.errors import UserError
from pp_cl.sweep import cluster

pytestmark = pytest.mark.slow


def _about_worker():
    return os.environ.get("PP_DEVICE"), os.getpid(), signal.getsignal(signal.SIGINT)


def test_workers_have_devices_of_their_own_and_listen_on_loopback_alone():
    with cluster.local_client(["0:0", "0:1"], 3) as client:
        about = client.run(_about_worker).values()
        assert sorted(device for device, _, _ in about) == ["0:0", "0:0", "0:1"]
        assert {handler for _, _, handler in about} == {signal.SIG_IGN}
        assert all(address.startswith("tls://127.0.0.1:") for address in client.nthreads())
        assert set(client.nthreads().values()) == {1}
        pids = {os.getpid(), *(pid for _, pid, _ in about)}
        listening = {
            connection.laddr.ip
            for pid in pids
            for connection in psutil.Process(pid).net_connections()
            if connection.status == psutil.CONN_LISTEN
        }
    assert len(pids) == 4 and listening == {"127.0.0.1"}
    assert not any(psutil.pid_exists(pid) for pid in pids - {os.getpid()})


def test_workers_that_do_not_start_are_one_line(monkeypatch):
    """As where a process may open few files, of which each worker takes a dozen."""

    class Failing(cluster.Nanny):
        async def start_unsafe(self):
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(cluster, "Nanny", Failing)
    with pytest.raises(UserError) as caught, cluster.local_client(["0:0"], 1):
        pass
    message = str(caught.value)
    assert "workers" in message and "Too many open files" in message and "\n" not in message


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "what://127.0.0.1:1"])
def test_nobody_at_the_address(monkeypatch, address):
    monkeypatch.setattr(cluster, "ANSWER", 1)
    with pytest.raises(UserError) as caught, cluster.client_of(address):
        pass
    assert address in str(caught.value) and "\n" not in str(caught.value)


class FakeClient:
    """A client of a cluster whose workers have these numbers of threads."""

    def __init__(self, threads):
        self.threads = threads

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def wait_for_workers(self, count, timeout):
        if len(self.threads) < count:
            raise TimeoutError

    def nthreads(self):
        return {f"tcp://w{i}": n for i, n in enumerate(self.threads)}


@pytest.mark.parametrize(
    "threads, words", [([1, 4], ["tcp://w1", "4 runs", "--nthreads 1"]), ([], ["no workers"])]
)
def test_workers_that_a_sweep_cannot_use(monkeypatch, threads, words):
    monkeypatch.setattr(cluster, "Client", lambda *_, **__: FakeClient(threads))
    with pytest.raises(UserError) as caught, cluster.client_of("tcp://s"):
        pass
    assert all(word in str(caught.value) for word in ["--scheduler tcp://s", *words])


def future(status, exception=None):
    return SimpleNamespace(status=status, exception=lambda: exception)


def test_tasks_that_end_without_a_row(tmp_path):
    (job,) = jobs_of(["demo"], tmp_path)
    killed = KilledWorker("k", SimpleNamespace(address="a"), 3)
    row = cluster._row(future("error", killed), job)
    assert row["error"].startswith("several workers ended") and str(job.log) in row["error"]
    row = cluster._row(future("error", ValueError("odd\nmore")), job)
    assert row["error"] == "ValueError: odd"
    assert cluster._row(future("error", ValueError()), job)["error"] == "ValueError: "
    assert "scheduler is gone" in cluster._row(future("cancelled"), job)["error"]


def test_it_is_told_where_a_process_still_works(tmp_path):
    jobs = jobs_of(["demo"], tmp_path, [1, 2, 3])
    for job in jobs[:2]:
        job.lock.parent.mkdir(parents=True)
        job.lock.touch()
    with FileLock(jobs[0].lock):
        assert cluster.await_ends(jobs, 0.1) == [jobs[0]]
    assert cluster.await_ends(jobs, 0.1) == []


@pytest.mark.parametrize("package", ["distributed", "filelock", "cryptography"])
def test_a_missing_package_is_one_line(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "pp_cl.sweep.cluster")
    with pytest.raises(UserError, match=r"pip install 'pp-cl\[sweep\]'"):
        importlib.import_module("pp_cl.sweep.cluster")
