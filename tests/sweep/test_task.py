"""A run's process as a worker watches it; other programs stand in for the training."""

import re
import sys
import time

import pytest
from support.sweeps import jobs_of, pretend

from pp_cl.sweep import task


@pytest.fixture
def job(tmp_path):
    """A planned run, whose folders are made."""
    (job,) = jobs_of(["demo"], tmp_path / "out", [4])
    task.prepare([job])
    return job


@pytest.fixture
def supervised(job, monkeypatch):
    """supervise() of the job where its process runs the given Python text."""

    def supervise(text, is_wanted=lambda: True):
        monkeypatch.setattr(task, "COMMAND", [sys.executable, "-c", text])
        return task.supervise(job, is_wanted, "7")

    return supervise


def test_the_process_gets_the_job_and_the_row_is_that_of_the_folder(job, supervised):
    pretend(job, 21.5)
    row = supervised("import sys; print(sys.stdin.readline())")
    assert row["psnr"] == 21.5 and "error" not in row
    first, line, _ = job.log.read_text().split("\n", 2)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d on worker 7, process \d+", first)
    assert line == job.to_json()


def test_a_user_error_is_the_rows_error(supervised, job):
    row = supervised("import sys; print('building'); sys.exit('x.json: broken; mend it')")
    assert row["error"] == "x.json: broken; mend it"
    assert (row["scene"], row["seed"], row["folder"]) == ("demo", 4, job.folder)


def test_a_bug_names_the_log_with_its_traceback(supervised, job):
    row = supervised("raise ValueError('odd')")
    assert row["error"] == f"ValueError: odd; see {job.log}"
    assert "Traceback" in job.log.read_text()


def test_what_an_earlier_process_said_is_kept_and_not_blamed(supervised, job):
    supervised("raise ValueError('odd')")
    assert supervised("import sys; sys.exit('mend it')")["error"] == "mend it"
    assert "odd" in job.log.read_text()


def test_a_process_that_is_killed(supervised, job):
    row = supervised("import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    assert row["error"] == f"its process was ended by signal 9; see {job.log}"


def test_a_process_that_is_stopped_by_somebody_else(supervised):
    assert "the same command goes on" in supervised("pass")["error"]
    assert supervised("raise SystemExit(1)")["error"] == "nothing was said"


def test_a_finished_folder_does_not_hide_a_failure(supervised, job):
    pretend(job, 21.5)
    assert supervised("import sys; sys.exit('mend it')")["error"] == "mend it"


def test_a_run_that_is_not_wanted_any_more_is_told_by_the_end_of_its_input(supervised, job):
    begin, asked = time.monotonic(), []

    def is_wanted():
        asked.append(0)
        return len(asked) < 3

    text = "import sys; sys.stdin.read(); print('told')"
    assert supervised(text, is_wanted)["error"] == "stopped"
    assert len(asked) == 3 and job.log.read_text().endswith("told\n")
    assert time.monotonic() - begin < 20


def test_a_worker_that_does_not_see_the_folder(job, tmp_path):
    job.log.parent.rmdir()
    row = task.supervise(job, lambda: True, "7")
    assert "worker 7" in row["error"] and "same files" in row["error"]
    assert str(tmp_path / "out" / "demo") in row["error"]


def test_a_log_that_cannot_be_written_is_named(job):
    job.log.symlink_to("/dev/full")
    row = task.supervise(job, lambda: True, "7")
    assert row["error"].startswith(f"{job.log}: ") and row["error"].endswith("free some space")
