import json
import shutil
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from support.refused import failure
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.files.image import read_rgba, write_png
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.run import load


@pytest.fixture(scope="module")
def run(runs, tmp_path_factory):
    """A finished run on the ball. Its reduced images have sides that are no multiples of 4."""
    changes = {"train__iterations": 40, "train__crop": 28, "train__prune_weight": 0}
    return runs.trained(tmp_path_factory.mktemp("evaluate") / "run", runs.ball(size=60), **changes)


def test_the_files_hold_what_was_measured_and_shown(run, capsys):
    assert main(["eval", str(run), "--save-images"]) == 0
    result = json.loads((run / "eval" / "metrics.json").read_text())
    assert result["split"] == "test" and set(result["mean"]) == {"psnr", "ssim"}
    assert 0 < result["points"]["final"] <= result["points"]["initial"]
    assert len(result["points"]["grid"]) == 3 and result["finished"]
    assert result["seconds_per_frame"] > 0 and result["published"] == {}
    assert f"{result['mean']['psnr']:.4f}" in capsys.readouterr().out
    assert (run / "eval" / "comparison.png").is_file()
    values = [row["psnr"] for row in result["per_image"]]
    assert len(values) == 2 and result["mean"]["psnr"] == pytest.approx(np.mean(values))
    scene = json.loads((run / "config.json").read_text())["scene"]["path"]
    for i, value in enumerate(values):
        image = np.asarray(Image.open(run / "eval" / "images" / f"r_{i}.png").convert("RGB"))
        rgba = read_rgba(f"{scene}/test/r_{i}.png").astype(np.float64) / 255
        over_white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        truth = np.rint(255 * over_white.reshape(30, 2, 30, 2, 3).mean((1, 3))).astype(np.uint8)
        assert image.shape == (30, 30, 3)
        assert psnr(image, truth) == pytest.approx(value, abs=0.02)
    assert main(["eval", str(run), "--split", "train", "--save-images"]) == 0
    assert len(json.loads((run / "eval" / "train" / "metrics.json").read_text())["per_image"]) == 8
    assert len(list((run / "eval" / "train" / "images").iterdir())) == 8
    assert main(["eval", str(run)]) == 0
    again = json.loads((run / "eval" / "metrics.json").read_text())
    assert again["per_image"] == result["per_image"]


def test_views_of_another_size(run, capsys):
    """At the training's own size the figures are the same but for eight bits a channel."""
    longest = load(run).cameras("test")[0].width
    means = []
    for words in ([], ["--size", str(longest)], ["--size", str(longest + 5)]):
        assert main(["eval", str(run), *words]) == 0
        folder = run / "eval" / "-".join(["size", *words[1:]]) if words else run / "eval"
        means.append(json.loads((folder / "metrics.json").read_text())["mean"])
        size = longest + 5 * (words[1:] == [str(longest + 5)])
        assert (f" of {size}x{size})" in capsys.readouterr().out) == bool(words)
    assert means[0] == pytest.approx(means[1], rel=2e-3) != pytest.approx(means[2], rel=2e-3)
    assert "r_0.png has" in failure("eval", run, "--size", "5000")


def test_figures_are_written_after_their_picture(run, tmp_path, monkeypatch):
    """If it is stopped in between, `make` evaluates again."""
    monkeypatch.setattr("pp_cl.evaluate.write_comparison", Mock(side_effect=KeyboardInterrupt))
    assert main(["eval", str(run), "--out", str(tmp_path / "eval")]) == 130
    assert not (tmp_path / "eval/metrics.json").exists()


def test_what_an_earlier_evaluation_left_goes_with_the_next(run):
    stale, own = run / "eval" / "images" / "cam0" / "r_7.png", run / "eval" / "images" / "own.png"
    killed = run / "eval" / "images" / f".r_0.png.{2**22 + 1}.pp-cl.tmp"
    stale.parent.mkdir(parents=True, exist_ok=True)
    write_png(stale, np.zeros((8, 8, 3)))
    for file in (own, killed):
        file.write_bytes(b"")
    assert main(["eval", str(run), "--save-images"]) == 0
    files_left = [p.name for p in sorted((run / "eval" / "images").rglob("*"))]
    assert files_left == ["own.png", "r_0.png", "r_1.png"]
    own.unlink()


def changed_scene(run, tmp_path, split, name):
    scene = json.loads((run / "config.json").read_text())["scene"]["path"]
    shutil.copytree(scene, tmp_path / "ball")
    pixels = np.array(Image.open(tmp_path / "ball" / split / name))
    pixels[5, 5, 1] ^= 1
    Image.fromarray(pixels).save(tmp_path / "ball" / split / name)
    return str(tmp_path / "ball")


def test_another_scene_is_refused_and_nothing_written(run, tmp_path):
    assert main(["eval", str(run)]) == 0
    before = (run / "eval" / "metrics.json").read_bytes()
    other = write_ball_scene(tmp_path / "other", size=60, views=7)
    changed = changed_scene(run, tmp_path, "train", "r_0.png")
    for scene, reason in ((other, "other names or cameras"), (changed, "train/r_0.png: other pix")):
        error = failure("eval", run, "--scene", scene)
        assert "checkpoint.npz: belongs to another scene" in error and reason in error
    assert (run / "eval" / "metrics.json").read_bytes() == before


def test_a_scene_without_training_views_is_measured_with_one_line(run, tmp_path, capsys):
    scene = changed_scene(run, tmp_path, "train", "r_1.png")
    (tmp_path / "ball" / "transforms_train.json").unlink()
    assert main(["eval", str(run), "--scene", scene]) == 0
    [line] = capsys.readouterr().err.splitlines()
    assert "cannot be compared with the scene of" in line and "no split train" in line


def test_published_rows_are_printed_beside_what_compares(run, tmp_path, capsys, monkeypatch):
    scene = json.loads((run / "config.json").read_text())["scene"]["path"]
    shutil.copytree(scene, tmp_path / "34_1479_4753")
    command = ["eval", str(run), "--scene", str(tmp_path / "34_1479_4753"), "--out"]
    for compares in (False, True):
        if compares:
            monkeypatch.setattr("pp_cl.evaluate.differences", lambda *_: "")
        out = tmp_path / f"eval{compares}"
        assert main([*command, str(out)]) == 0
        result = json.loads((out / "metrics.json").read_text())
        assert len(result["published"]) == 5
        assert ("reduced 2 times" in result["published_differs"]) == (not compares)
        assert ("PlenopticPoints" in capsys.readouterr().out) == compares
