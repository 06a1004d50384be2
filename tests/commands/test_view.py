"""`pp-cl view` as a process, and beside a training."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.run_folder import RunFolder
from pp_cl.session import run_config
from pp_cl.view.serve import serve

SECONDS = 60


@pytest.fixture
def begun(tmp_path):
    """A run that has its settings and no checkpoint."""
    folder = RunFolder(tmp_path / "run")
    folder.create(run_config(folder, write_ball_scene(tmp_path / "ball")).to_json())
    return folder.path


def started(*words):
    """A process `pp-cl view`."""
    return subprocess.Popen(
        [sys.executable, "-m", "pp_cl", "view", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def status(address):
    try:
        with urllib.request.urlopen(address, timeout=SECONDS) as response:  # noqa: S310
            return response.status
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.unix
def test_the_address_works_and_ctrl_c_ends_cleanly(begun):
    process = started(begun, "--port", "0")
    try:
        address = process.stdout.readline().split()[1]
        assert address.startswith("http://127.0.0.1:")
        assert status(address) == 200
        assert status(address.rsplit("/", 2)[0] + "/") == 403
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
    assert process.returncode == 0 and err == "" and out == ""


@pytest.mark.unix
@pytest.mark.parametrize("host", ["localhost", "0.0.0.0", "::"])  # noqa: S104
def test_the_address_of_a_host_works(begun, host):
    """Whichever of its numbers the name of this machine stands for; only others' reach warns."""
    process = started(begun, "--host", host, "--port", "0")
    try:
        assert status(process.stdout.readline().split()[1]) == 200
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
    assert ("nothing is encrypted" in err) == (host != "localhost")


def test_a_signal_to_terminate_in_the_midst_of_a_task_ends_cleanly(begun, caplog):
    """What serves a tab, or the first lines of the server itself, may be interrupted by it."""
    tasks = []

    async def terminated():
        signal.raise_signal(signal.SIGTERM)

    def announce(_address):
        tasks.append(asyncio.get_running_loop().create_task(terminated()))

    before = signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as of a shell's job in the background
    try:
        serve(begun, host="127.0.0.1", port=0, announce=announce)
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert tasks[0].done() and tasks[0].exception() is None and not caplog.records


def test_a_busy_port_is_one_line_and_status_2(begun, capsys):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert main(["view", str(begun), "--port", str(port)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and f"--port {port}: another program uses it" in lines[0]
    assert main(["view", str(begun), "--port", "70000"]) == 2


def test_another_host_warns_and_one_that_is_not_ours_is_refused(begun, capsys):
    assert main(["view", str(begun), "--host", "192.0.2.1", "--port", "0"]) == 2
    warning, error = capsys.readouterr().err.splitlines()
    assert "nothing is encrypted" in warning and "--host 192.0.2.1" in error


def test_a_missing_framework_names_the_extra(begun, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["view", str(begun)]) == 2
    assert "pip install aiohttp" in capsys.readouterr().err


def test_a_training_shows_itself_and_ends_what_it_started(tmp_path, capfd, monkeypatch):
    """The browser is a script that notes the address it gets, and what answers there."""
    browser, noted = tmp_path / "browser.py", tmp_path / "noted"
    browser.write_text(
        "import os, re, sys, urllib.request\n"
        "mode = os.stat(sys.argv[1].removeprefix('file://')).st_mode & 0o777\n"
        "text = urllib.request.urlopen(sys.argv[1]).read().decode()\n"
        "address = re.search('url=([^\"]*)', text)[1]\n"
        "page = urllib.request.urlopen(address).status\n"
        f"open({str(noted)!r}, 'w').write(f'{{sys.argv[1]}} {{mode:o}} {{address}} {{page}}')\n"
    )
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.setenv("BROWSER", f"{sys.executable} {browser} %s")
    scene = write_ball_scene(tmp_path / "ball")
    wait_for_the_browser(monkeypatch, noted)
    assert main([*arguments(scene, tmp_path / "run", train__iterations=3), "--view"]) == 0
    argument, mode, address, page = noted.read_text().split()
    assert page == "200" and address in capfd.readouterr().out
    assert mode == "600" and address.split("/")[-2] not in argument
    assert argument.startswith((tmp_path / "pp-cl-view-").as_uri())  # not hidden, not in /tmp
    assert not os.path.exists(argument.removeprefix("file://"))
    with pytest.raises(urllib.error.URLError):
        status(address)
    assert json.loads((tmp_path / "run" / "log.jsonl").read_text().splitlines()[-1])["finished"]


def wait_for_the_browser(monkeypatch, noted):
    """Let the training's first step take until the page was opened."""
    from pp_cl.train import Trainer

    train_step = Trainer.train_step

    def waiting(self):
        deadline = time.monotonic() + SECONDS
        while not (noted.exists() and noted.read_text()) and time.monotonic() < deadline:
            time.sleep(0.1)
        return train_step(self)

    monkeypatch.setattr(Trainer, "train_step", waiting)


def test_a_waiting_server_ends_with_its_parent(tmp_path):
    """A parent that is killed cannot end its child itself."""
    child = [sys.executable, "-m", "pp_cl", "view", str(tmp_path / "run"), "--wait", "--port", "0"]
    script = (
        "import subprocess, sys, os\n"
        "pipes = dict.fromkeys(('stdin', 'stdout'), subprocess.PIPE)\n"
        f"child = subprocess.Popen({child!r}, **pipes, text=True)\n"
        "print(child.pid, child.stdout.readline().split()[1], flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    parent = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, timeout=SECONDS
    )
    pid, address = parent.stdout.split()
    deadline = time.monotonic() + SECONDS
    try:
        while is_served(address):
            assert time.monotonic() < deadline
            time.sleep(0.1)
    except AssertionError:
        os.kill(int(pid), signal.SIGTERM)
        raise


@pytest.mark.unix
def test_a_waiting_server_is_ended_by_a_signal_though_its_input_is_open(tmp_path):
    child = [sys.executable, "-m", "pp_cl", "view", str(tmp_path / "run"), "--wait", "--port", "0"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(child, **pipes, text=True) as server:
        assert is_served(server.stdout.readline().split()[1])
        server.terminate()
        try:
            assert server.wait(SECONDS) in (0, 143)
        finally:
            server.kill()
        assert not server.stderr.read()


def is_served(address):
    try:
        return status(address) == 200
    except (urllib.error.URLError, ConnectionError):
        return False
