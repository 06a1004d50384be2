"""Where what is printed cannot go: pipes that nobody reads, full disks, closed streams."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
NO_STREAM = (
    "import os, sys; os.close({}); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
)


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """A quick command."""
    path = tmp_path_factory.mktemp("output") / "a.png"
    Image.new("RGB", (16, 16)).save(path)
    return ["compare", str(path), str(path), "--metrics", "psnr"]


def run(words, closed=None, **streams):
    """The ended process of a command. closed: number of a stream that is not there."""
    before = ["-c", NO_STREAM.format(closed)] if closed else []
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    return subprocess.run(
        [sys.executable, *before, "-m", "pp_cl", *words],
        cwd=ROOT,
        check=False,
        text=True,
        **streams,
    )


@pytest.fixture
def unread():
    """The end of a pipe that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_pipe_that_nobody_reads_is_one_line(words, unread, unbuffered):
    ended = run(words, stdout=unread, env={**os.environ, "PYTHONUNBUFFERED": unbuffered})
    assert ended.returncode == 141
    assert ended.stderr == "pp-cl: nobody reads what is printed any more; stopped\n"


def test_help_that_nobody_reads_is_no_error(unread):
    ended = run(["--help"], stdout=unread)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_full_disk_under_stdout_is_one_line(words):
    with open("/dev/full", "w") as full:
        ended = run(words, stdout=full)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("pp-cl: ") and "No space left" in ended.stderr


def test_a_full_disk_under_stderr_changes_no_status(words):
    with open("/dev/full", "w") as full:
        assert run(["compare", "a", "b"], stderr=full).returncode == 2
        ended = run(words, stderr=full)
    assert ended.returncode == 0 and "psnr" in ended.stdout


@pytest.mark.parametrize("closed", [1, 2])
def test_a_closed_stream_takes_nothing(words, closed):
    ended = run(words, closed)
    assert ended.returncode == 0 and ended.stderr == ""
    assert ended.stdout == ("" if closed == 1 else "psnr   100.0000\n")
    ended = run(["compare", "no.png", "no.png"], closed)
    assert ended.returncode == 2 and ended.stdout == ""


def test_letters_that_an_encoding_lacks_are_printed_as_codes():
    code = "from pp_cl.cli import main; main(['compare', 'a', 'b']); print('k\\u00e4fer')"
    words, ascii_only = [sys.executable, "-c", code], {**os.environ, "PYTHONIOENCODING": "ascii"}
    ended = subprocess.run(words, cwd=ROOT, env=ascii_only, capture_output=True, check=True)
    assert ended.stdout == b"k\\xe4fer\n"
