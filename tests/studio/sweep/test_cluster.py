import os
import re
import signal
import sys

import psutil
import pytest
from support.checkpoints import load_checkpoint
from support.refused import refusing
from support.scenes import write_ball_scene
from support.sweeps import jobs_of

from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_studio.sweep import cluster
from pp_studio.sweep.table import finished_row

pytestmark = pytest.mark.slow


def _about_worker():
    return os.getpid(), signal.getsignal(signal.SIGINT)


def _tell_devices():
    cluster.run_job = lambda job, device, is_stopped: device


def test_workers_have_devices_of_their_own_and_listen_on_loopback_alone():
    with cluster.local_client(3) as client:
        about = client.run(_about_worker).values()
        assert {handler for _, handler in about} == {signal.SIG_IGN}
        assert all(address.startswith("tls://127.0.0.1:") for address in client.nthreads())
        assert set(client.nthreads().values()) == {1}
        pids = {os.getpid(), *(pid for pid, _ in about)}
        listening = {
            connection.laddr.ip
            for pid in pids
            for connection in psutil.Process(pid).net_connections()
            if connection.status == psutil.CONN_LISTEN
        }
        client.run(_tell_devices)
        taken = [
            client.submit(cluster.run_task, None, ["0:0", "0:1"], "stop", workers=[i], pure=False)
            for i in range(3)
        ]
        assert [future.result() for future in taken] == ["0:0", "0:1", "0:0"]
    assert len(pids) == 4 and listening == {"127.0.0.1"}
    assert not any(psutil.pid_exists(pid) for pid in pids - {os.getpid()})


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "what://127.0.0.1:1"])
def test_nobody_at_the_address(monkeypatch, address):
    monkeypatch.setattr(cluster, "ANSWER", 1)
    with refusing(address), cluster.client_of(address):
        pass


@pytest.fixture
def job(tmp_path):
    (job,) = jobs_of([write_ball_scene(tmp_path / "ball")], tmp_path / "out", [4])
    job.log.parent.mkdir(parents=True)
    return job


def test_a_stopped_run_goes_on_and_is_measured(job):
    asked = []

    def is_stopped():
        asked.append(0)
        return len(asked) == 7

    row = cluster.run_job(job, None, is_stopped)
    assert row["error"] == "stopped" and (row["scene"], row["seed"]) == ("ball", 4)
    header, _ = load_checkpoint(RunFolder(job.folder).checkpoint)
    assert header["step"] == 6 and not header["finished"]
    assert cluster.run_job(job, None, lambda: True) == row  # it makes no further step
    assert load_checkpoint(RunFolder(job.folder).checkpoint)[0] == header
    row = cluster.run_job(job, None, lambda: False)
    assert row == finished_row(job) and row["psnr"] > 5
    assert len(re.findall(rf"process {os.getpid()}\n", job.log.read_text())) == 3
    checkpoint = RunFolder(job.folder).checkpoint.stat()
    assert cluster.run_job(job, None, lambda: False) == row  # it is not trained again
    assert RunFolder(job.folder).checkpoint.stat() == checkpoint


@pytest.mark.parametrize(
    "error, said",
    [
        (UserError("x: fix it"), "x: fix it"),
        (OSError(28, "No space left", "a.npz"), "OSError: [Errno 28] No space left: 'a.npz'; see"),
        (TypeError("a\nbug"), "TypeError: a bug; see"),
    ],
)
def test_what_goes_wrong_is_the_rows_error(job, monkeypatch, error, said):
    def failing(*_, **__):
        print("said meanwhile", file=sys.stderr)
        raise error

    monkeypatch.setattr(cluster, "train_scene", failing)
    assert cluster.run_job(job, None, lambda: False)["error"].startswith(said)
    log = job.log.read_text()
    assert "said meanwhile\n" in log and ("Traceback" in log) == ("see" in said)


def test_a_scene_that_cannot_be_measured_is_not_trained(tmp_path):
    scene = write_ball_scene(tmp_path / "ball", splits=("train",))
    (job,) = jobs_of([scene], tmp_path / "out")
    job.log.parent.mkdir(parents=True)
    assert "no split test" in cluster.run_job(job, None, lambda: False)["error"]
    assert not RunFolder(job.folder).config.exists()
