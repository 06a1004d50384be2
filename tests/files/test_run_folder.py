import errno
import json
import signal

import numpy as np
import pytest
from support.refused import refusing

from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.files.run_folder import RunFolder

ROWS = [{"step": step, "seconds": step / 10, "loss": 1.0} for step in (5, 10, 15)]


def write(folder, *lines):
    folder.log.write_bytes(b"".join(line + b"\n" for line in lines))


@pytest.fixture
def folder(tmp_path):
    folder = RunFolder(tmp_path)
    write(folder, *(json.dumps(row).encode() for row in ROWS))
    return folder


def rows(folder):
    return [json.loads(line) for line in folder.log.read_text().splitlines()]


def test_rows_after_the_step_are_cut_off_and_made_again(folder, recwarn):
    with folder.log.open("ab") as file:
        file.write(b'{"step": 20, "sec')
    assert folder.rows() == ROWS
    with folder.open_log(10) as log:
        assert log.seconds == 1.0 and rows(folder) == ROWS[:2]
        log.write(ROWS[2] | {"finished": True})
    with folder.open_log(15) as log:
        assert log.seconds == 1.0 and rows(folder) == ROWS[:2]
    assert not recwarn.list


def test_a_log_of_at_most_so_many_bytes(folder, monkeypatch):
    monkeypatch.setattr("pp_cl.files.run_folder.MOST_LOG", folder.log.stat().st_size - 1)
    with refusing(folder.log, "larger than"):
        folder.rows()


@pytest.mark.parametrize(
    "line",
    [
        b'{"step": 10, "sec',
        b"\xff\xfe",
        b'{"step": 10}',
        b'{"step": 10, "seconds": 1.0, "psnr": NaN}',
        b"[" * 100_000,
        b'{"step": 10, "seconds": 1.0, "rates": ' + b"[" * 900 + b"]" * 900 + b"}",
        b'{"step": -10, "seconds": 1.0}',
        b'{"step": 4, "seconds": 1.0}',
        b'{"step": 10, "seconds": 0.1}',
        b'{"step": 10, "seconds": ' + b"9" * 400 + b"}",
        b'{"step": 10, "seconds": 1.0, "psnr": "20"}',
        b'{"step": 10, "seconds": 1.0, "points": [301]}',
        b'{"step": 10, "seconds": 1.0, "rates": {"sh": [1, -Infinity]}}',
        b'{"step": 10, "seconds": 1.0, "device": [1]}',
        b'{"step": 10, "seconds": 1.0, "x": "' + b"y" * 2**17 + b'"}',
    ],
)
def test_a_damaged_log_is_cut_off_there(folder, line):
    write(folder, json.dumps(ROWS[0]).encode(), line, json.dumps(ROWS[2]).encode())
    with pytest.warns(UserWarning, match="line 2 is not a row of a log"):
        assert folder.rows() == ROWS[:1]
    with pytest.warns(UserWarning, match="line 2 is not a row of a log") as warned:
        log = folder.open_log(20)
    with log:
        assert log.seconds == 0.5 and rows(folder) == ROWS[:1]
    (message,) = (str(warning.message) for warning in warned)
    assert message.startswith(f"{folder.log}: ") and message.isprintable()


@pytest.mark.unix
def test_a_full_disk_is_one_line_that_names_the_log(folder):
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # Python does so, but Intel's runtime undoes it
    with folder.open_log(10) as log:
        resource.setrlimit(resource.RLIMIT_FSIZE, (folder.log.stat().st_size + 10, limits[1]))
        try:
            with pytest.raises(UserError, match="log.jsonl: cannot be written .*free some space"):
                log.write(ROWS[2])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with pytest.warns(UserWarning, match="line 3 is not a row"), folder.open_log(15):
        assert rows(folder) == ROWS[:2]


def test_a_start_that_fails_early_leaves_a_folder_of_a_run_or_an_empty_one(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")

    def fail(*_):
        raise UserError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("pp_cl.files.run_folder.write_text", fail)
        with folder.owned(), pytest.raises(UserError, match="the disk is full"):
            folder.create("{}")
    folder.check_usable()
    (folder.path / ".step.png.999999999.pp-cl.tmp").write_bytes(b"half")  # left by a killed process
    with folder.owned():
        folder.create("{}")
    assert folder.config.read_text() == "{}\n" and folder.previews.is_dir()
    assert not list(folder.path.glob("*.tmp*")) and not list(folder.path.glob(".*.tmp*"))


def test_images_without_a_checkpoint_go_and_others_stay(tmp_path):
    folder = RunFolder(tmp_path)
    folder.create("{}")
    ours = [tmp_path / "masks.png", folder.previews / "step_000030.png"]
    others = [tmp_path / "notes.png", folder.previews / "mine.png"]
    for path in ours:
        write_png(path, np.zeros((8, 8, 3)))
    for path in others:
        path.write_bytes(b"image")
    folder.checkpoint.write_bytes(b"whole")
    folder.create("{}")
    assert all(path.exists() for path in ours + others)
    folder.checkpoint.unlink()
    folder.create("{}")
    assert not any(path.exists() for path in ours) and all(path.exists() for path in others)
    write_png(ours[1], np.zeros((8, 8, 3)))
    ours[1].write_bytes(b"with an arrow")
    folder.check_sheets(30)  # accepted, as this sheet would not be written again
    with pytest.raises(UserError, match=f"{ours[1]}: pp-cl did not write this"):
        folder.check_sheets(29)


def test_a_file_system_without_locks_is_one_line(tmp_path, monkeypatch):
    def acquire(self):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("pp_cl.files.run_folder.FileLock.acquire", acquire)
    with pytest.raises(UserError, match="run/.pp-cl.lock: cannot be locked .No locks available"):
        RunFolder(tmp_path / "run").owned().__enter__()
