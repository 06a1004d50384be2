import io
import os
import subprocess
import sys

import pytest

from pp_cl.cli import main

NOTHING = ("eval", "no/such/run")
NO_RUN = b"pp-cl: no/such/run/config.json: No such file or directory; is this the folder of a run?"


def program(words, **options):
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    words = [sys.executable, "-m", "pp_cl", *words]
    return subprocess.run(words, timeout=120, check=False, **options)


def test_output_and_errors_that_nobody_reads():
    reading, writing = os.pipe()
    os.close(reading)
    done = program(["--version"], stdout=writing)
    assert done.returncode == 141
    assert done.stderr.splitlines() == [b"pp-cl: nobody reads the output any more"]
    os.close(writing)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has it")
def test_streams_that_are_full():
    with open("/dev/full", "wb") as full:
        done = program(["train", "--help"], stdout=full)
        assert done.returncode == 2
        assert done.stderr.startswith(b"pp-cl: file: No space left on device")
        assert done.stderr.count(b"\n") == 1


def test_streams_that_are_closed():
    done = [
        subprocess.run(
            ["/bin/sh", "-c", f'exec "$0" -m pp_cl eval no/such/run {closed}', sys.executable],
            stderr=subprocess.PIPE,
            check=False,
        )
        for closed in (">&-", "2>&-")
    ]
    assert [process.returncode for process in done] == [2, 2]
    assert done[0].stderr.splitlines() == [NO_RUN] and done[1].stderr == b""


def test_letters_that_an_encoding_lacks(tmp_path):
    path = tmp_path / "gr\u00fc\u00df"
    done = program(["eval", str(path)], env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 2 and b"gr\\xfc\\xdf/config.json: No such file" in done.stderr


def test_the_streams_of_a_caller_are_left_alone(monkeypatch):
    """The streams are not files, as in a notebook."""
    out, err = io.StringIO(), io.StringIO()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setattr("sys.stderr", err)
    assert main(NOTHING) == 2
    assert out.getvalue() == "" and err.getvalue().encode().strip() == NO_RUN
