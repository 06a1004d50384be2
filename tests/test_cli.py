import json
import shutil
import signal
import subprocess
import sys
import warnings
from textwrap import dedent

import numpy as np
import pytest
from PIL import Image
from support.refused import failure

from pp_cl.cli import main
from pp_cl.errors import BuildError


def test_devices_are_listed_and_without_one_it_is_said_what_to_install(
    scene, tmp_path, capsys, monkeypatch
):
    assert main(["devices"]) == 0
    assert "works" in capsys.readouterr().out
    assert main(["devices", "--json"]) == 0
    assert any(d["problem"] is None and d["name"] for d in json.loads(capsys.readouterr().out))
    monkeypatch.setattr("pp_cl.drivers.list_devices", lambda **_: [])
    for words in (["train", scene, "--out", tmp_path / "run"], ["devices"]):
        assert "install" in failure(*words)


@pytest.mark.parametrize("action", ["ignore", "error"])
def test_what_is_told_is_for_no_filter_of_pythons(runs, tmp_path, capsys, action):
    """Notebooks and images of Docker set PYTHONWARNINGS."""
    folder = shutil.copytree(runs.ball(views=12, size=32), tmp_path / "scene")
    sorted((folder / "train").iterdir())[0].write_bytes(b"no image")
    with warnings.catch_warnings():
        warnings.simplefilter(action)
        assert main(["info", str(folder)]) == 0
    assert "views left out" in capsys.readouterr().err


def test_without_a_command_the_help_is_printed(capsys):
    assert main([]) == 0
    printed = capsys.readouterr()
    assert "train" in printed.out and "usage: pp-cl" in printed.out and not printed.err


def test_a_run_that_lies_in_runs_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "mine"
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}")
    for command in ("eval", "info", "compare"):
        assert "runs/mine?" in failure(command, "mine")


def test_compare_writes_the_table_and_the_file(tmp_path, capsys):
    rng, files = np.random.default_rng(0), [str(tmp_path / f"{name}.png") for name in "ab"]
    for file in files:
        Image.fromarray(rng.integers(0, 256, (24, 24, 3), np.uint8)).save(file)
    assert main(["compare", *files, "--json", str(tmp_path / "m.json")]) == 0
    result = json.loads((tmp_path / "m.json").read_text())
    assert f"{result['mean']['psnr']:.4f}" in capsys.readouterr().out
    assert "none.png" in failure("compare", tmp_path / "none.png", files[1])


def test_a_kernel_that_does_not_build_is_one_line_below_the_log(scene, tmp_path, monkeypatch):
    def broken(*_, **__):
        raise BuildError(
            "cl/a.cl does not build on a device with -DA=1", "<kernel>:3:\nno such type\n"
        )

    monkeypatch.setattr("pp_cl.session.training.open_training", broken)
    line = failure("train", scene, "--out", tmp_path / "run", "--downscale", "1")
    assert line.startswith(
        "pp-cl: cl/a.cl does not build on a device with -DA=1; update the driver"
    )


SIGINT = "signal.raise_signal(signal.SIGINT)"


@pytest.mark.parametrize(
    "told, then, status",
    [
        pytest.param("130", SIGINT, -signal.SIGINT, marks=pytest.mark.unix),
        (SIGINT, "raise SystemExit(told)", 130),
    ],
)
def test_a_further_interrupt_shows_no_traceback(told, then, status):
    """main() has already reported the first interrupt."""
    lines = f"""
        import signal
        from pp_cl import cli
        cli.main = lambda argv: {told}
        told = cli.program()
        {then}
    """
    done = subprocess.run([sys.executable, "-c", dedent(lines)], capture_output=True, text=True)
    assert done.returncode == status
    assert "Traceback" not in done.stderr


def test_a_library_that_finds_no_memory_is_one_line_and_other_faults_of_it_are_bugs(monkeypatch):
    errors = [ImportError("x.so: failed to map segment from shared object"), ImportError("x")]
    monkeypatch.setattr("pp_cl.commands.devices.run", lambda _: (_ for _ in ()).throw(errors[0]))
    error = failure("devices")
    assert "x.so" in error and "memory" in error
    del errors[0]
    with pytest.raises(ImportError):
        main(["devices"])


def test_a_command_imports_its_own_module_alone():
    ours = ("pp_studio", "pp_cl.commands.")
    code = (
        "import json, sys\nfrom pp_cl.cli import main\n"
        "try: main(['devices', '--help'])\nexcept SystemExit: pass\n"
        f"print(json.dumps([n for n in sys.modules if n.startswith({ours})]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *_, last = done.stdout.splitlines()
    expected = {f"pp_cl.commands.{name}" for name in ("devices", "options", "signals")}
    assert set(json.loads(last)) == expected
