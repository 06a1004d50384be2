import json
import shutil

import pytest
from support.runs import train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_studio.export import FORMATS


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    scene = write_ball_scene(folder / "ball", views=6, size=40)
    with pytest.MonkeyPatch.context() as patch:
        train_and_interrupt(scene, folder / "run", 20, patch)
    return folder / "run"


@pytest.fixture
def copied(unfinished, tmp_path):
    """A copy of the run, in a folder whose name is not UTF-8, with its scene gone."""
    run = tmp_path / "run \udcff"
    shutil.copytree(unfinished, run)
    config = json.loads((run / "config.json").read_text())
    config["scene"]["path"] = "/nowhere/at/all"
    (run / "config.json").write_text(json.dumps(config))
    return run


# no mesh, as so little training shows no surface; tests/studio/export/test_formats.py writes one
@pytest.mark.parametrize("name", [name for name in FORMATS if name != "mesh"])
def test_every_format_goes_to_its_place_and_the_run_is_named_unfinished(name, copied, capsys):
    assert main(["export", str(copied), "--format", name]) == 0
    written, printed = copied / "export" / FORMATS[name][0], capsys.readouterr()
    shown = ascii(str(written)).strip("'")
    assert written.exists() and f"wrote {shown}: " in printed.out
    assert "unfinished, step 20 of 60" in printed.out
    # the scene is needed for its test views, and for the images that Gaussians are fitted to
    is_fitted = name.startswith("splat") or name in ("html", "gallery")
    assert ("/nowhere/at/all" in printed.err) == (name == "scene" or is_fitted)
    there = [path.name for path in written.parent.iterdir() if path.name[0] != "."]
    assert there == [written.name]


def test_out_says_where(copied, tmp_path, capsys):
    out = tmp_path / "a.ply"
    assert main(["export", str(copied), "--format", "ply", "--out", str(out)]) == 0
    whole = out.stat().st_size
    words = ["--format", "ply", "--out", str(out), "--min-weight", "0.3"]
    assert main(["export", str(copied), *words]) == 0
    assert out.stat().st_size < whole and not (copied / "export").exists()
