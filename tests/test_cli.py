"""The command line as a user meets it: what it prints, its exit status, and one line for whatever
is wrong.
"""

import json
import signal
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from PIL import Image
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import preset
from pp_cl.errors import BuildError


def failure(capsys, *words):
    """The one line on stderr of a command that must end with exit status 2."""
    capsys.readouterr()
    assert main([str(w) for w in words]) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("pp-cl")]
    assert (
        len(lines) == 1
        and captured.err.rstrip().endswith(lines[0])
        and "Traceback" not in captured.err
    )
    return lines[0]


@pytest.fixture
def scene(tmp_path):
    """A small scene to be damaged."""
    return Path(write_ball_scene(tmp_path / "ball", views=4, size=32))


def edit(scene, change):
    """Apply change(dict) to the training json."""
    path = scene / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def damaged_frame(**changes):
    return lambda s: edit(s, lambda content: content["frames"][1].update(changes))


# what the readers' own tests have in full
DAMAGE = {
    "no such folder": (lambda s: s.rename(s.parent / "elsewhere"), "ball"),
    "missing json": (lambda s: (s / "transforms_train.json").unlink(), "ball: no split train"),
    "broken json": (
        lambda s: (s / "transforms_train.json").write_text('{"frames": ['),
        "transforms_train.json",
    ),
    "path leaves": (damaged_frame(file_path="../../secret"), "file_path"),
    "wrong shape": (damaged_frame(transform_matrix=[[1, 0], [0, 1]]), "transform_matrix"),
    "missing image": (lambda s: (s / "train" / "r_1.png").unlink(), "train/r_1"),
    "empty mask": (lambda s: Image.new("RGBA", (32, 32)).save(s / "train" / "r_1.png"), "r_1.png"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_scene_is_one_line_and_writes_nothing(name, scene, tmp_path, capsys):
    damage, named = DAMAGE[name]
    damage(scene)
    assert named in failure(
        capsys, "train", scene, "--out", tmp_path / "run", "--points", 500, "--iterations", 2
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "words, named",
    [
        (["--iterations", "0"], "--iterations: train.iterations"),
        (["--iterations", "x"], "--iterations"),
        (["--points", "0"], "--points: points.count"),
        (["--set", "train.crop=6"], "--set: train.crop"),
        (["--downscale", "20"], "--downscale"),
        (["--set", "train.sped=1"], "train.sped"),
        (["--set", "nonsense"], "--set nonsense"),
        (["--preset", "huge"], "--preset"),
        (["--speed", "9"], "--speed"),
        (["--device", "abacus"], "abacus"),
        (["--seed", "-1"], "train.seed"),
        (["--eval-every", "often"], "--eval-every"),
    ],
)
def test_bad_options_are_one_line_and_write_nothing(words, named, scene, tmp_path, capsys):
    assert named in failure(capsys, "train", scene, "--out", tmp_path / "run", *words)
    assert not (tmp_path / "run").exists()


def test_a_foreign_folder_is_not_written_into(scene, tmp_path, capsys):
    out = tmp_path / "photos"
    out.mkdir()
    (out / "holiday.jpg").write_bytes(b"")
    assert "photos" in failure(capsys, "train", scene, "--out", out)
    assert [p.name for p in out.iterdir()] == ["holiday.jpg"]
    (tmp_path / "file").write_text("")
    assert "file" in failure(capsys, "train", scene, "--out", tmp_path / "file")


def test_a_folder_that_cannot_be_made_is_one_line(scene, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert "file/run" in failure(capsys, "train", scene, "--out", tmp_path / "file" / "run")


def test_no_device_says_what_to_install(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pp_cl.device.discover.list_devices", lambda: [])
    assert "pocl" in failure(capsys, "train", scene, "--out", tmp_path / "run")
    assert "pocl" in failure(capsys, "devices")


def test_devices_lists_a_working_one(capsys):
    assert main(["devices"]) == 0
    assert "works" in capsys.readouterr().out
    assert main(["devices", "--json"]) == 0
    assert any(d["problem"] is None and d["name"] for d in json.loads(capsys.readouterr().out))


def test_without_a_command_or_with_an_unknown_one(capsys):
    assert "command" in failure(capsys)
    assert "paint" in failure(capsys, "paint")


@pytest.mark.parametrize(
    "words, begin, near",
    [
        (["trian"], "pp-cl: ", "train"),
        (["train", "demo", "--out", "a", "--iters", "6"], "pp-cl train: ", "--iterations"),
        (["train", "demo", "--out", "a", "--preset", "smal"], "pp-cl train: ", "small"),
        (["train", "demo", "--out", "a", "--set", "trian.seed=1"], "pp-cl: ", "train.seed"),
        (["compare", "a", "b", "--metrics", "psrn"], "pp-cl compare: ", "psnr"),
    ],
)
def test_the_nearest_word_is_named_behind_one_prefix(words, begin, near, capsys):
    line = failure(capsys, *words)
    assert line.startswith(begin)
    assert f"did you mean {near}?" in line


def test_a_run_that_lies_in_runs_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "mine"
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}")
    for command in ("eval", "info", "shape", "compress"):
        assert "runs/mine?" in failure(capsys, command, "mine")


def test_help_lists_settings_and_the_module_runs():
    run = subprocess.run(
        [sys.executable, "-m", "pp_cl", "train", "--help"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[1],
        check=True,
    )
    assert "train.sh_rate" in run.stdout and "--downscale" in run.stdout
    (line,) = [x for x in run.stdout.splitlines() if x.startswith("  train.iterations = ")]
    assert line.endswith("small: 6000  full: 11000  paper: 50000")


def test_eval_of_nothing_and_of_broken_runs(tmp_path, capsys):
    assert "config.json" in failure(capsys, "eval", tmp_path / "none")
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    assert "format" in failure(capsys, "eval", run)
    config = preset("tiny")
    config.scene.path = "demo"
    (run / "config.json").write_text(config.to_json())
    assert "checkpoint.npz" in failure(capsys, "eval", run)
    (run / "checkpoint.npz").write_bytes(b"PK\x03\x04 not really")
    assert "corrupt" in failure(capsys, "eval", run)
    assert "--metrics" in failure(capsys, "eval", run, "--metrics", "beauty")


def test_compare_writes_the_table_and_the_file(tmp_path, capsys):
    rng, files = np.random.default_rng(0), [str(tmp_path / f"{name}.png") for name in "ab"]
    for file in files:
        Image.fromarray(rng.integers(0, 256, (24, 24, 3), np.uint8)).save(file)
    assert main(["compare", *files, "--json", str(tmp_path / "m.json")]) == 0
    result = json.loads((tmp_path / "m.json").read_text())
    assert f"{result['mean']['psnr']:.4f}" in capsys.readouterr().out
    assert "none.png" in failure(capsys, "compare", tmp_path / "none.png", files[1])


def test_a_kernel_that_does_not_build_is_one_line_below_the_log(
    scene, tmp_path, capsys, monkeypatch
):
    def broken(*_, **__):
        raise BuildError(
            "cl/a.cl does not build on a device with -DA=1", "<kernel>:3:\nno such type\n"
        )

    monkeypatch.setattr("pp_cl.session.open_training", broken)
    line = failure(capsys, "train", scene, "--out", tmp_path / "run", "--downscale", "1")
    assert line.startswith(
        "pp-cl: cl/a.cl does not build on a device with -DA=1; update the driver"
    )


def test_what_was_typed_breaks_no_line(tmp_path, capsys):
    line = failure(capsys, "eval", f"{tmp_path}/a\nb\x1b[31m")
    assert f"{tmp_path}/a b?[31m/config.json" in line


@pytest.mark.parametrize(
    "told, then, status",
    [
        ("130", "os.kill(os.getpid(), signal.SIGINT)", -signal.SIGINT),
        ("os.kill(os.getpid(), signal.SIGINT)", "raise SystemExit(told)", 130),
        ("1 / 0", "", 1),
    ],
)
def test_a_further_interrupt_shows_no_traceback(told, then, status):
    """Of a process whose main() has told of the first."""
    lines = f"""
        import os, signal
        from pp_cl import cli
        cli.main = lambda argv: {told}
        told = cli.program()
        {then}
    """
    done = subprocess.run([sys.executable, "-c", dedent(lines)], capture_output=True, text=True)
    assert done.returncode == status
    assert ("Traceback" in done.stderr) == (status == 1)


def test_a_library_that_finds_no_memory_is_one_line_and_other_faults_of_it_are_bugs(
    monkeypatch, capsys
):
    errors = [ImportError("x.so: failed to map segment from shared object"), ImportError("x")]
    monkeypatch.setattr("pp_cl.commands.devices.run", lambda _: (_ for _ in ()).throw(errors[0]))
    assert main(["devices"]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and "x.so" in told[0] and "memory" in told[0]
    del errors[0]
    with pytest.raises(ImportError):
        main(["devices"])
