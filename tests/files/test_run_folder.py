"""The folder of a run: its log survives whatever stands in it, and a full disk is told."""

import json
import resource

import pytest

from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder

ROWS = [{"step": step, "seconds": step / 10, "loss": 1.0} for step in (5, 10, 15)]


def write(folder, *lines):
    folder.log.write_bytes(b"".join(line + b"\n" for line in lines))


@pytest.fixture
def folder(tmp_path):
    """A run's folder with three rows in its log."""
    folder = RunFolder(tmp_path)
    write(folder, *(json.dumps(row).encode() for row in ROWS))
    return folder


def rows(folder):
    return [json.loads(line) for line in folder.log.read_text().splitlines()]


def test_rows_after_the_step_are_cut_off_and_made_again(folder):
    with folder.open_log(10) as log:
        assert log.seconds == 1.0 and rows(folder) == ROWS[:2]
        log.write(ROWS[2])
        assert rows(folder) == ROWS


def test_a_finished_row_is_made_again(folder):
    write(folder, json.dumps(ROWS[0]).encode(), b'{"step": 10, "seconds": 1.0, "finished": true}')
    with folder.open_log(10) as log:
        assert log.seconds == 0.5 and rows(folder) == ROWS[:1]


@pytest.mark.parametrize(
    "line",
    [
        b'{"step": 10, "sec',
        b"\xff\xfe",
        b"7",
        b"{}",
        b'{"step": 10}',
        b'{"step": "10", "seconds": 1.0}',
        b'{"step": 10, "seconds": "1"}',
        b'{"step": 10, "seconds": 1.0, "psnr": NaN}',
        b'{"step": 10, "seconds": 1e999}',
        b"[" * 100_000,
    ],
)
def test_a_damaged_log_is_cut_off_there(folder, line):
    write(folder, json.dumps(ROWS[0]).encode(), line, json.dumps(ROWS[2]).encode())
    with folder.open_log(20) as log:
        assert log.seconds == 0.5 and rows(folder) == ROWS[:1]


def test_a_full_disk_is_one_line_that_names_the_log(folder):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with folder.open_log(10) as log:
        resource.setrlimit(resource.RLIMIT_FSIZE, (folder.log.stat().st_size + 10, limits[1]))
        try:
            with pytest.raises(UserError, match="log.jsonl: cannot be written .*free some space"):
                log.write(ROWS[2])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with folder.open_log(10):
        assert rows(folder) == ROWS[:2]


def test_a_row_never_holds_nan(folder):
    with folder.open_log(10) as log, pytest.raises(ValueError, match="not JSON compliant"):
        log.write({"step": 15, "seconds": 1.5, "loss": float("nan")})
    assert rows(folder) == ROWS[:2]


def test_leftovers_are_removed_from_the_folder_and_the_previews(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.previews.mkdir(parents=True)
    for place in (folder.path, folder.previews):
        (place / ".step.png.1.tmp").write_bytes(b"half")
    folder.create("{}")
    assert [p.name for p in folder.path.rglob("*") if p.is_file()] == ["config.json"]


def test_the_test_split_is_evaluated_into_eval_itself(tmp_path):
    folder = RunFolder(tmp_path)
    assert folder.evaluation("test") == tmp_path / "eval"
    assert folder.evaluation("train") == tmp_path / "eval" / "train"
