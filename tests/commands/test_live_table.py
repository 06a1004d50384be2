"""What a sweep shows while it runs."""

import io
import os

import pytest
from support.sweeps import jobs_of

from pp_cl.commands import live_table
from pp_cl.commands.live_table import LiveTable
from pp_cl.sweep.result import failed_row
from pp_cl.sweep.task import prepare


class Terminal(io.StringIO):
    """Text that is shown to somebody."""

    def isatty(self):
        return True


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    """Three planned runs, with folders for their logs; a block is always old enough."""
    monkeypatch.setattr(live_table, "REDRAWN", 0)
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((40, 24)))
    jobs = jobs_of(["demo"], tmp_path, [1, 2, 3])
    prepare(jobs)
    return jobs


def test_a_file_gets_a_line_for_each_run_that_ends(jobs):
    stream = io.StringIO()
    table = LiveTable(stream, jobs[1:], 1)
    jobs[1].log.write_text("begun")
    table.tick()
    assert stream.getvalue() == ""
    table.end(failed_row(jobs[1], "odd"))
    table.tick()
    assert stream.getvalue() == "[2 of 3] demo seed 2: failed: odd\n"


def test_a_terminal_also_gets_a_block_that_is_drawn_over(jobs):
    stream = Terminal()
    jobs[0].log.write_text("of an earlier sweep")
    table = LiveTable(stream, jobs, 0)
    table.tick()
    first = "0 of 3 runs done, 0 at work\n"
    assert stream.getvalue() == first
    jobs[1].log.write_text("begun")
    assert table.at_work() == [jobs[1]]
    table.tick()
    second = "  demo seed 2: beginning\n0 of 3 runs done, 1 at work\n"
    assert stream.getvalue() == f"{first}\x1b[1F\x1b[J{second}"
    table.end(failed_row(jobs[1], "odd " * 20))
    table.tick()
    ended = f"\x1b[2F\x1b[J[1 of 3] demo seed 2: failed: {'odd ' * 20}\n"
    third = "1 of 3 runs done, 1 failed, 0 at work\n"
    assert stream.getvalue() == f"{first}\x1b[1F\x1b[J{second}{ended}{third}"


def test_lines_of_the_block_fit_the_terminal(jobs, monkeypatch):
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((12, 3)))
    stream = Terminal()
    table = LiveTable(stream, jobs, 0)
    for job in jobs:
        job.log.write_text("begun")
    table.tick()
    assert stream.getvalue().splitlines() == ["  demo seed", "0 of 3 runs"]


def test_a_young_block_is_left(jobs, monkeypatch):
    monkeypatch.setattr(live_table, "REDRAWN", 1000)
    stream = Terminal()
    table = LiveTable(stream, jobs, 0)
    table.tick()
    table.tick()
    assert stream.getvalue().count("runs done") == 1
