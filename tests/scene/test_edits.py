import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.refused import failure
from support.runs import arguments, train_and_interrupt

from pp_cl.cli import main
from pp_cl.config import configure, preset
from pp_cl.scene.edits import Edits, read_edits, write_edits
from pp_cl.scene.listing import scene_box, scene_frames

BOX = [[-0.5, -1, -1], [1, 1, 0.25]]


@pytest.fixture
def folder(scene, tmp_path):
    return Path(shutil.copytree(scene, tmp_path / "ball"))


def test_training_and_info_obey_the_box_and_leave_out_what_was_dropped(folder, tmp_path, capsys):
    write_edits(folder, Edits(np.array(BOX), frozenset({"train/r_2.png", "test/r_0.png"})))
    assert [view.name for view in scene_frames(folder, "test")] == ["test/r_1.png"]
    assert main(arguments(str(folder), tmp_path / "run", train__iterations=2)) == 0
    header, _ = load_checkpoint(tmp_path / "run" / "checkpoint.npz")
    names = [name for name, _ in header["views"]]
    assert names == [f"train/r_{i}.png" for i in (0, 1, 3, 4, 5, 6, 7)]
    grid = header["grid"]
    low = np.array(grid["origin"])
    high = low + grid["voxel_size"] * (np.array(grid["dims"]) - 1)
    assert (low >= np.array(BOX[0]) - 1e-6).all() and (high <= np.array(BOX[1]) + 1e-6).all()
    capsys.readouterr()
    assert main(["info", str(folder), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["box"] == BOX and facts["splits"] == {"train": 7, "test": 1}
    assert facts["dropped"] == ["test/r_0.png", "train/r_2.png"]
    config = configure(preset("tiny"), folder, [("scene.box", "-2,-2,-2,2,2,2", "--set")])
    assert scene_box(config)[1, 2] == 2, "a setting goes before"


def test_a_run_knows_its_scene_after_views_were_dropped(folder, tmp_path, capsys, monkeypatch):
    """The run can be evaluated; a training would have other bits, so it refuses and says why."""
    run, half = tmp_path / "run", tmp_path / "half"
    assert main(arguments(str(folder), run, train__iterations=2)) == 0
    train_and_interrupt(str(folder), half, 11, monkeypatch)
    write_edits(folder, Edits(None, frozenset({"train/r_2.png"})))
    capsys.readouterr()
    assert main(["eval", str(run)]) == 0
    assert "views were dropped or taken back" in failure("train", folder, "--out", half)
    write_edits(folder, Edits())
    assert main(["train", str(folder), "--out", str(half)]) == 0


def test_no_edits_leave_no_file(folder):
    edits = Edits(np.array(BOX), frozenset({"train/r_2.png"}))
    write_edits(folder, edits)
    box, dropped, axes = read_edits(folder)
    assert box.tolist() == BOX and dropped == edits.dropped and axes is None
    write_edits(folder, Edits())
    assert not (folder / "pp_cl.json").exists() and read_edits(folder) == Edits()


@pytest.mark.parametrize(
    "text",
    ["{", "[]", '{"boxes": 1}', '{"box": [[0, 0, 0], [1, 1]]}', '{"box": [[0,0,0],[1,1,0]]}']
    + ['{"box": [[0,0,0],[1,1,NaN]]}', '{"dropped": "a"}'],
)
def test_a_broken_file_is_one_line_that_names_it(folder, text):
    (folder / "pp_cl.json").write_text(text)
    assert "pp_cl.json" in failure("info", folder)


def test_a_scene_whose_views_are_all_dropped_says_by_what(folder):
    names = [f"train/r_{i}.png" for i in range(8)]
    (folder / "pp_cl.json").write_text(json.dumps({"dropped": names}))
    assert "pp_cl.json" in failure("info", folder)
