"""A log is followed while it is written."""

import json
import os

from pp_cl.files.run_folder import RunFolder
from pp_cl.view.follow import LogFollower


def row(step, psnr=20.0):
    return json.dumps({"step": step, "seconds": 1.0, "loss": 0.5, "psnr": psnr}) + "\n"


def test_rows_come_as_they_are_written(tmp_path):
    log = LogFollower(tmp_path / "log.jsonl")
    assert not log.poll() and log.rows == []
    log.path.write_text(row(1) + row(2))
    assert log.poll() and log.rows == [[1, 0.5, 20.0], [2, 0.5, 20.0]]
    assert not log.poll()


def test_a_truncated_last_line_waits_for_its_end(tmp_path):
    log = LogFollower(tmp_path / "log.jsonl")
    log.path.write_text(row(1) + row(2)[:17])
    assert log.poll() and [r[0] for r in log.rows] == [1]
    with open(log.path, "a") as file:
        file.write(row(2)[17:-1])
    assert not log.poll()
    with open(log.path, "a") as file:
        file.write("\n" + row(3))
    assert log.poll() and [r[0] for r in log.rows] == [1, 2, 3]


def test_lines_that_are_no_rows_are_left_out(tmp_path):
    log = LogFollower(tmp_path / "log.jsonl")
    finished = '{"step": 4, "seconds": 2, "points": 3, "finished": true}\n'
    broken = ["\n", "x\n", "[1]\n", '{"step": NaN, "loss": 1, "psnr": 1}\n', "[" * 9000 + "\n"]
    log.path.write_bytes(
        "".join([row(1), *broken, finished]).encode() + b"\xff\n" + row(5).encode()
    )
    assert log.poll() and [r[0] for r in log.rows] == [1, 5]


def test_a_resumed_training_begins_the_log_anew(tmp_path):
    folder = RunFolder(tmp_path)
    log = LogFollower(folder.log)
    folder.log.write_text(row(5) + row(10) + row(15))
    assert log.poll() and log.starts == 0
    with folder.open_log(10) as writer:
        writer.write({"step": 15, "seconds": 2.0, "loss": 0.1, "psnr": 30.0})
    assert log.poll() and log.starts == 1
    assert log.rows == [[5, 0.5, 20.0], [10, 0.5, 20.0], [15, 0.1, 30.0]]


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "log.jsonl")
    follower = LogFollower(tmp_path / "log.jsonl")
    assert not follower.poll() and follower.rows == []
