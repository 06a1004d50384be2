import importlib
import re
import shutil
import signal

import pytest
from support.runs import spoken

from pp_cl.cli import main
from pp_cl.commands import COMMANDS
from pp_cl.files.atomic import own, write_json
from pp_cl.files.image import read_rgba
from pp_studio.capture import STAGES
from pp_studio.commands import make, render


@pytest.fixture(scope="module")
def made(runs, tmp_path_factory):
    """(scene, what was made of it) of a ball."""
    scene = runs.ball(views=12, size=32)

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(render, "LEAST_HEIGHT", 32)  # of the video, which would take a minute
            status, lines = spoken(["make", scene, "--out", folder / "out", "--minutes", "0.1"])
        assert status == 0, lines

    folder = tmp_path_factory.mktemp("make") / "out"
    return scene, shutil.copytree(runs.made("make", make) / "out", folder)


def test_the_page_links_what_is_there(made):
    _, folder = made
    page = (folder / "index.html").read_text("utf-8")
    named = set(re.findall(r'(?:src|href|content)="([\w.]+\.\w+)"', page))
    assert named == {"model.html", "video.mp4", "splat.ply", "views.png", "thumbnail.png"}
    assert all((folder / name).stat().st_size > 0 for name in named)
    assert "<title>out</title>" in page and "<!--" not in page
    assert "PSNR, dB" in page and "the training has not seen" in page
    assert read_rgba(folder / "thumbnail.png").shape == (315, 600, 4)


def test_the_same_command_does_only_what_is_left(made, capsys):
    scene, folder = made
    checkpoint = (folder / "run/checkpoint.npz").read_bytes()
    (folder / "index.html").unlink()
    made = [(folder / name).stat().st_mtime_ns for name in ("video.mp4", "splat.ply")]
    assert main(["make", scene, "--out", str(folder)]) == 0
    assert "is finished" in capsys.readouterr().out
    assert made == [(folder / name).stat().st_mtime_ns for name in ("video.mp4", "splat.ply")]
    assert (folder / "index.html").exists()
    assert (folder / "run/checkpoint.npz").read_bytes() == checkpoint
    status, lines = spoken(["make", scene, "--out", folder, "--minutes", "7"])
    assert status == 2 and f"{folder}: was begun with --minutes 0.1; leave it out" in lines[-1]


def test_commands_of_a_run_take_the_one_that_was_made(made, tmp_path, capsys, monkeypatch):
    _, folder = made
    assert main(["info", str(folder)]) == 0
    assert f"{folder / 'run'}, preset" in capsys.readouterr().out
    file = tmp_path / "points.ply"
    assert main(["export", str(folder), "--format", "ply", "--out", str(file)]) == 0
    assert file.exists()
    shown = []
    monkeypatch.setattr(
        "pp_studio.view.run_view.RunView", lambda _, __, run, ___: shown.append(run)
    )
    with pytest.raises(AttributeError):  # of what is not there to serve
        main(["view", str(folder), "--port", "0"])
    assert shown[0].path == folder / "run"


@pytest.mark.parametrize("stage, number", [("eval", signal.SIGTERM), ("render", signal.SIGINT)])
def test_a_signal_ends_it_and_the_same_command_goes_on(made, capsys, monkeypatch, stage, number):
    scene, folder = made
    words, real = ["make", scene, "--out", str(folder)], importlib.import_module(COMMANDS[stage])
    for name in ("index.html", "video.mp4"):
        (folder / name).unlink(missing_ok=True)

    def signalled(options):
        signal.raise_signal(number)

    with monkeypatch.context() as patch:
        patch.setattr(real, "run", signalled)
        assert main(words) == 128 + number
    assert capsys.readouterr().err.splitlines()[-1] == "pp-cl: interrupted"
    assert main(words) == 0
    assert (folder / "index.html").exists() and (folder / "video.mp4").exists()


def test_what_is_not_its_own_stays(made, tmp_path):
    scene, folder = made
    (tmp_path / "mine.txt").write_text("mine")
    status, lines = spoken(["make", scene, "--out", tmp_path])
    assert status == 2 and "holds other files" in lines[-1]
    page = folder / "index.html"
    page.write_text(page.read_text("utf-8") + "mine", "utf-8")
    status, lines = spoken(["make", scene, "--out", folder])
    assert status == 2 and "index.html: pp-cl did not write this" in lines[-1]
    assert page.read_text("utf-8").endswith("mine")


class Enough(Exception):
    """The steps are known."""


@pytest.mark.parametrize(
    "words, preset",
    [
        ([], "small"),
        (["--minutes", "3"], "tiny"),
        (["--minutes", "60"], "full"),
        (["--preset", "tiny"], "tiny"),
    ],
)
def test_photographs_are_captured_first(tmp_path, monkeypatch, words, preset):
    steps = []

    def step(name, *given):
        steps.append((name, given))
        for stage in STAGES if name == "capture" else ():
            write_json(found / f"{stage}.json", {"line": f"{stage} done"})
        if name == "train":
            raise Enough

    monkeypatch.setattr(make, "_step", step)
    monkeypatch.setattr(make, "_share", lambda: 1.0)
    monkeypatch.setattr("pp_studio.export.result.write_result", lambda *given: None)
    photographs, found = tmp_path / "photographs", tmp_path / "out/scene/capture"
    photographs.mkdir()
    found.mkdir(parents=True)
    own(tmp_path / "out")
    hints = ["--turntable", "--masks", "M", "--box=-1,-1,-1,1,1,2"]
    with pytest.raises(Enough):
        spoken(["make", photographs, "--out", tmp_path / "out", *hints, *words])
    scene, box = str(tmp_path / "out/scene"), "--box=-1.0,-1.0,-1.0,1.0,1.0,2.0"
    minutes = {"3": "2", "60": "55"}.get(words[-1] if words else "", "15")
    assert steps == [
        ("capture", (str(photographs), "--out", scene, "--turntable", "--masks", "M", box)),
        (
            "train",
            (scene, "--out", str(tmp_path / "out/run"), "--preset", preset, "--minutes", minutes),
        ),
    ]


def test_hints_of_photographs_are_refused_for_a_scene(made, tmp_path):
    scene, _ = made
    status, lines = spoken(["make", scene, "--out", tmp_path / "new", "--turntable"])
    assert status == 2 and "--turntable" in lines[-1] and not (tmp_path / "new").exists()
    status, lines = spoken(["make", tmp_path / "none", "--out", tmp_path / "new"])
    assert status == 2 and "give photographs, a video or a scene" in lines[-1]
