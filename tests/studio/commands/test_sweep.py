import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from support.checkpoints import load_checkpoint
from support.scenes import write_ball_scene
from support.sweeps import jobs_of, pretend, words_of

from pp_cl.cli import main
from pp_cl.config import run_config
from pp_cl.drivers import open_device
from pp_cl.engine.training import specular
from pp_cl.evaluate import evaluate_run
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load
from pp_cl.session.training import open_training

ROOT = Path(__file__).parents[3]
STEPS = specular.STEPS  # before a fixture lowers it


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    return [write_ball_scene(folder / "ball"), write_ball_scene(folder / "globe", views=5)]


@pytest.fixture
def nothing_starts(monkeypatch):
    monkeypatch.setitem(sys.modules, "pp_studio.sweep.cluster", None)
    monkeypatch.setitem(sys.modules, "distributed", None)


def test_a_dry_run_says_what_would_be_done(tmp_path, capsys, nothing_starts):
    jobs = jobs_of(["demo"], tmp_path / "out", [1, 2, 3, 4])
    pretend(jobs[1], 20.0, 0.5)
    pretend(jobs[2], 21.0, finished=False)
    (other,) = jobs_of(["demo"], tmp_path / "out", [4], given=[("points.count", "9", "--set")])
    pretend(other, 22.0)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert main(words_of(["demo"], tmp_path / "out", "--seeds", "1,2,3,4", "--dry-run")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        "demo seed 1: to do",
        "demo seed 2: finished: PSNR 20.00, SSIM 0.5000, points 10, seconds 2.0",
    ]
    assert lines[2] == "demo seed 3: to go on"
    assert lines[3].startswith("demo seed 4: will fail: ") and "points.count" in lines[3]
    assert lines[4] == "4 runs, 1 of them finished already; nothing was started"
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_a_finished_sweep_needs_no_dask(tmp_path, capsys, nothing_starts):
    out = tmp_path / "out"
    for job, psnr in zip(jobs_of(["demo"], out, [1, 2]), (20.0, 23.0), strict=True):
        pretend(job, psnr)
    assert main(words_of(["demo"], out, "--seeds", "1,2")) == 0
    assert "| demo |      2 | 21.50" in capsys.readouterr().out
    stored = json.loads((out / "sweep.json").read_text())
    assert [row["folder"] for row in stored["runs"]] == ["demo/seed-1", "demo/seed-2"]


def start(words, **options):
    return subprocess.Popen([sys.executable, "-m", "pp_cl", *words], cwd=ROOT, **options)


def first(find, seconds=100):
    last = time.monotonic() + seconds
    while time.monotonic() < last:
        if value := find():
            return value
        time.sleep(0.02)
    raise AssertionError("waited in vain")


def checkpoints(out):
    return list(out.glob("*/seed-?/checkpoint.npz"))


def worker_of(checkpoint):
    log = checkpoint.parent.with_suffix(".log").read_text()
    return int(re.findall(r"process (\d+)", log)[-1])


def undisturbed(dev, job):
    folder = RunFolder(job.folder)
    open_training(dev, folder, run_config(folder, job.scene, None, job.given), None).run()
    return evaluate_run(load(folder.path, dev), "test", job.metrics)


@pytest.mark.unix
@pytest.mark.slow
def test_a_sweep_survives_the_death_of_a_worker(scenes, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    words = words_of(scenes, out, "--seeds", "1,2", "--workers", "2")
    with start(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as sweep:
        os.kill(worker_of(first(lambda: checkpoints(out))[0]), signal.SIGKILL)
        lines = sweep.stderr.read().splitlines()
    assert sweep.returncode == 0
    assert [line[:8] for line in lines] == [f"[{i} of 4]" for i in (1, 2, 3, 4)]
    begun = [line for log in out.glob("*/*.log") for line in log.read_text().splitlines()]
    assert len(begun) == 5  # one run began twice
    rows = json.loads((out / "sweep.json").read_text())["runs"]
    plan, dev = jobs_of(scenes, tmp_path / "alone", [1, 2]), open_device()
    monkeypatch.setattr(specular, "STEPS", STEPS)  # as in the workers, which fixtures do not reach
    for row, job in zip(rows, plan, strict=True):
        expected = undisturbed(dev, job)
        assert (row["scene"], row["seed"]) == (job.name, job.seed)
        assert {name: row[name] for name in ("psnr", "ssim")} == expected["mean"]
        assert row["points"] == expected["points"]["final"] and row["seconds"] > 0
        same = [Path(folder, "checkpoint.npz") for folder in (out / row["folder"], job.folder)]
        assert same[0].read_bytes() == same[1].read_bytes()
    monkeypatch.setitem(sys.modules, "pp_studio.sweep.cluster", None)
    table = (out / "sweep.md").read_text()
    assert main(words) == 0
    assert (out / "sweep.md").read_text() == table


@pytest.mark.unix
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_sweep_and_its_workers_soon(scenes, tmp_path, number):
    out = tmp_path / "out"
    words = words_of(scenes, out, "--workers", "2", changes={"train.iterations": 100_000})
    with start(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as sweep:
        first(lambda: checkpoints(out))
        workers = psutil.Process(sweep.pid).children(recursive=True)
        begun = time.monotonic()
        sweep.send_signal(number)
        sweep.wait()
        took, lines = time.monotonic() - begun, sweep.stderr.read().splitlines()
    assert sweep.returncode == 128 + number and took < 5
    assert len([line for line in lines if line.startswith("pp-cl: ")]) == 1
    assert psutil.wait_procs(workers, timeout=20)[1] == []
    (header, _) = load_checkpoint(checkpoints(out)[0])
    assert not header["finished"]


@pytest.fixture
def scheduler():
    """Address of a scheduler with one worker, started like a user's."""
    tool = [sys.executable, "-m", "dask"]
    local = ["--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
    with subprocess.Popen(
        [*tool, "scheduler", "--port", "0", *local], stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            lines = iter(process.stderr.readline, "")
            address = next(m[0] for line in lines if (m := re.search(r"tcp://127\S+", line)))
            worker = [*tool, "worker", address, "--nthreads", "1", *local]
            with subprocess.Popen(worker, cwd=ROOT, stderr=subprocess.DEVNULL) as other:
                yield address
                other.terminate()
        finally:
            process.terminate()
            process.stderr.close()


@pytest.mark.unix
@pytest.mark.slow
def test_a_scheduler_started_by_hand(scenes, scheduler, tmp_path, capsys):
    out, broken = tmp_path / "out", Path(write_ball_scene(tmp_path / "broken"))
    (broken / "transforms_train.json").write_text("{")
    words = words_of([broken, scenes[0]], out, "--scheduler", scheduler)
    assert main(words) == 1
    printed = capsys.readouterr()
    assert printed.err.splitlines()[-1].startswith("pp-cl: 1 of 2 runs failed")
    bad, good = json.loads((out / "sweep.json").read_text())["runs"]
    assert "transforms_train.json" in bad["error"] and "psnr" not in bad
    assert 5 < good["psnr"] < 40
    assert "| broken |        0 of 1 |" in printed.out and "1 of 2 scenes" in printed.out
