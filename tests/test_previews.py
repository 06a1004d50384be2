import math
from pathlib import Path

from support.refused import failure
from support.runs import arguments, checkpoint, rows, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main


def test_the_split_val_is_measured_where_there_is_one(tmp_path):
    scene = write_ball_scene(tmp_path / "ball", splits=("train", "val", "test"))
    (Path(scene) / "test" / "r_0.png").write_bytes(b"")  # the test split must not be read
    changes = {"train__iterations": 2, "train__eval_every": 1}
    assert main(arguments(scene, tmp_path / "run", **changes)) == 0
    alone = write_ball_scene(tmp_path / "alone", splits=("train",))
    assert "--eval-every" in failure(*arguments(alone, tmp_path / "other", **changes))
    assert not (tmp_path / "other").exists()


def test_previews_and_measured_views_leave_the_run_as_it_is(tmp_path, monkeypatch):
    scene = write_ball_scene(tmp_path / "ball")
    none, many = tmp_path / "none", tmp_path / "many"
    for out, previews, first, more in ((none, 1, 1e9, []), (many, 7, 0, ["--eval-every", "12"])):
        monkeypatch.setattr("pp_cl.session.training.PREVIEWS", previews)
        monkeypatch.setattr("pp_cl.session.training.FIRST_PREVIEW", first)
        assert main([*arguments(scene, out, train__prune_weight=0), *more]) == 0
    names = [[p.name for p in sorted((run / "previews").iterdir())] for run in (none, many)]
    assert names[0] == ["step_000060.png"]
    assert names[1] == [
        f"step_{step:06d}.png" for step in (1, *(math.ceil(60 * n / 7) for n in range(1, 8)))
    ]
    assert checkpoint(none) == checkpoint(many)
    log = rows(many)
    tests = {row["step"]: row["test_psnr"] for row in log if "test_psnr" in row}
    assert list(tests) == [12, 24, 36, 48, 60] and tests[60] > tests[12] + 3
    assert all("psnr" in row for row in log[:-1])


def test_a_run_that_has_a_preview_needs_no_early_one(tmp_path, monkeypatch):
    scene, out = write_ball_scene(tmp_path / "ball"), tmp_path / "run"
    train_and_interrupt(scene, out, 35, monkeypatch)
    monkeypatch.setattr("pp_cl.session.training.FIRST_PREVIEW", 0)
    before = {p.name for p in (out / "previews").iterdir()}
    assert main(arguments(scene, out)) == 0
    after = {p.name for p in (out / "previews").iterdir()}
    assert after == before | {"step_000045.png", "step_000060.png"}
