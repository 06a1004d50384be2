"""The command pp-cl export: what it writes where, and one line for whatever is wrong."""

import json
import os
import shutil

import pytest
from support.runs import train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.export.formats import FORMATS
from pp_cl.run import Run


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    """A run that was interrupted."""
    folder = tmp_path_factory.mktemp("export")
    scene = write_ball_scene(folder / "ball", views=6, size=40)
    with pytest.MonkeyPatch.context() as patch:
        train_and_interrupt(scene, folder / "run", 20, patch)
    return folder / "run"


@pytest.fixture
def copied(unfinished, tmp_path):
    """A copy of it, in a folder whose name is no UTF-8, and whose scene is gone."""
    run = tmp_path / os.fsdecode(b"run \xff")
    shutil.copytree(unfinished, run)
    config = json.loads((run / "config.json").read_text())
    config["scene"]["path"] = "/nowhere/at/all"
    (run / "config.json").write_text(json.dumps(config))
    return run


def failure(capsys, *words):
    """The one line on stderr of a command that must end with exit status 2."""
    capsys.readouterr()
    assert main(["export", *map(str, words)]) == 2
    error = capsys.readouterr().err.splitlines()
    lines = [line for line in error if line.startswith("pp-cl")]
    assert len(lines) == 1 and error[-1] == lines[0]
    return lines[0]


# so little training shows no surface; tests/export/test_formats.py writes a mesh
@pytest.mark.parametrize("name", [name for name in FORMATS if name != "mesh"])
def test_every_format_goes_to_its_place_and_the_run_is_named_unfinished(name, copied, capsys):
    assert main(["export", str(copied), "--format", name]) == 0
    written, said = copied / "export" / FORMATS[name][0], capsys.readouterr()
    shown = ascii(str(written)).strip("'")
    assert written.exists() and f"wrote {shown}: " in said.out
    assert "unfinished, step 20 of 60" in said.out
    assert ("/nowhere/at/all" in said.err) == (name == "scene")  # whose test views it has not
    assert [path.name for path in written.parent.iterdir()] == [written.name]


def test_out_says_where(copied, tmp_path, capsys):
    out = tmp_path / "a.ply"
    assert main(["export", str(copied), "--format", "ply", "--out", str(out)]) == 0
    whole = out.stat().st_size
    words = ["--format", "ply", "--out", str(out), "--min-weight", "0.3"]
    assert main(["export", str(copied), *words]) == 0
    assert out.stat().st_size < whole and not (copied / "export").exists()


def forbidden(tmp_path):
    """A folder that may not be written: root may write everywhere but into /proc."""
    folder = tmp_path / "forbidden"
    folder.mkdir(mode=0o500)
    return "/proc" if os.access(folder, os.W_OK) else folder


WRONG = {
    "no such run": (["{tmp}/none", "--format", "ply"], "none"),
    "no format": (["{run}"], "--format"),
    "unknown format": (["{run}", "--format", "obj"], "obj"),
    "a folder for a file": (["{run}", "--format", "ply", "--out", "{tmp}/a.ply"], "is a folder"),
    "an empty name": (["{run}", "--format", "ply", "--out", ""], "--out"),
    "an empty scene": (["{run}", "--format", "ply", "--scene", ""], "--scene"),
    "a long name": (["{run}", "--format", "ply", "--out", "{tmp}/" + 250 * "x" + ".ply"], "name"),
    "here": (["{run}", "--format", "scene", "--out", "."], "name a new folder in it"),
    "no folder": (["{run}", "--format", "glb", "--out", "{tmp}/no/a.glb"], "is no folder"),
    "a file for a folder": (["{run}", "--format", "scene", "--out", "{run}/config.json"], "exists"),
    "a full folder": (["{run}", "--format", "scene", "--out", "{run}"], "exists already"),
    "other suffix": (["{run}", "--format", "mesh", "--out", "{tmp}/a.obj"], ".ply or .glb"),
    "a weight that is none": (["{run}", "--format", "ply", "--min-weight", "x"], "--min-weight"),
    "a weight for a page": (["{run}", "--format", "html", "--min-weight", "1"], "only ply and glb"),
    "a scene that is gone": (["{run}", "--format", "ply", "--scene", "{tmp}/gone"], "gone"),
    "no device": (["{run}", "--format", "ply", "--device", "abacus"], "abacus"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_is_one_line_and_writes_nothing(name, copied, tmp_path, capsys, monkeypatch):
    (tmp_path / "a.ply").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(Run, "render", None)  # that nothing is computed
    before = sorted(tmp_path.rglob("*"))
    words, named = WRONG[name]
    words = [word.format(run=copied, tmp=tmp_path) for word in words]
    assert named in failure(capsys, *words)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["ply", "glb", "html", "scene"])
def test_a_folder_that_may_not_be_written_is_one_line(name, copied, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Run, "render", None)
    out = os.path.join(forbidden(tmp_path), "a" + (FORMATS[name][1] or ("",))[0])
    assert out in failure(capsys, copied, "--format", name, "--out", out)
    assert not os.path.exists(out)


def test_a_run_of_softmax_has_no_page(copied, capsys):
    config = json.loads((copied / "config.json").read_text())
    config["raster"]["blend"] = "softmax"
    (copied / "config.json").write_text(json.dumps(config))
    assert "raster.blend softmax" in failure(capsys, copied, "--format", "html")
    assert not (copied / "export").exists()
