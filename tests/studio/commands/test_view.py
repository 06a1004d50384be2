import json
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest
from support.refused import failure
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import run_config
from pp_cl.files.run_folder import RunFolder

SECONDS = 60


@pytest.fixture
def begun(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create(run_config(folder, write_ball_scene(tmp_path / "ball")).to_json())
    return folder.path


def started(*words):
    return subprocess.Popen(
        [sys.executable, "-m", "pp_cl", "view", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def status(address):
    with urllib.request.urlopen(address, timeout=SECONDS) as response:  # noqa: S310
        return response.status


@pytest.mark.unix
@pytest.mark.parametrize("what, number", [("run", signal.SIGTERM), ("ball", signal.SIGINT)])
def test_the_address_works_and_a_signal_ends_it_cleanly(begun, what, number):
    """The subject is a run, or a scene."""
    process = started(begun.with_name(what), "--port", "0")
    try:
        address = process.stdout.readline().split()[1]
        assert address.startswith("http://127.0.0.1:")
        assert status(address) == 200
        process.send_signal(number)
        out, err = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
    assert (process.returncode, err, out) == (128 + number, "pp-cl: interrupted\n", "")


def test_a_busy_port_is_one_line_and_status_2(begun):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        error = failure("view", begun, "--port", port)
    assert f"--port {port}: " in error and "give another" in error


def test_another_host_warns_and_one_that_is_not_ours_is_refused(begun, capsys):
    assert main(["view", str(begun), "--host", "192.0.2.1", "--port", "0"]) == 2
    warning, error = capsys.readouterr().err.splitlines()
    assert "nothing is encrypted" in warning and "--host 192.0.2.1" in error


def test_without_viser_the_first_line_says_so(begun, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install viser" in failure("view", begun)
    train = arguments(str(tmp_path / "ball"), tmp_path / "new", train__iterations=3)
    assert main([*train, "--view"]) == 2
    out, err = capsys.readouterr()
    assert "pip install viser" in err and out == "" and not (tmp_path / "new").exists()


def test_a_training_shows_itself_in_the_browser_until_it_ends(tmp_path, capfd, monkeypatch):
    browser, noted = tmp_path / "browser.py", tmp_path / "noted"
    browser.write_text(
        "import sys, urllib.request\n"
        "page = urllib.request.urlopen(sys.argv[1]).status\n"
        f"open({str(noted)!r}, 'w').write(f'{{sys.argv[1]}} {{page}}')\n"
    )
    monkeypatch.setenv("BROWSER", f"{sys.executable} {browser} %s")
    scene = write_ball_scene(tmp_path / "ball")
    wait_for_the_browser(monkeypatch, noted)
    assert main([*arguments(scene, tmp_path / "run", train__iterations=3), "--view"]) == 0
    address, page = noted.read_text().split()
    assert page == "200" and f"watch at {address}\n" in capfd.readouterr().out
    with pytest.raises(urllib.error.URLError):
        status(address)
    assert json.loads((tmp_path / "run" / "log.jsonl").read_text().splitlines()[-1])["finished"]


def wait_for_the_browser(monkeypatch, noted):
    from pp_cl.engine.step import Trainer

    train_step = Trainer.train_step

    def waiting(self):
        deadline = time.monotonic() + SECONDS
        while not (noted.exists() and noted.read_text()) and time.monotonic() < deadline:
            time.sleep(0.1)
        return train_step(self)

    monkeypatch.setattr(Trainer, "train_step", waiting)
