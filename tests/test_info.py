import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.checkpoints import load_checkpoint
from support.refused import failure
from support.runs import arguments, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.engine.network.layers import multiplications
from pp_cl.engine.views import evenly
from pp_cl.files.image import read_rgba
from pp_cl.run import MARGIN, load
from pp_cl.scene.outline import OUTLINE

BALL = 0.8  # the ball's radius, support.scenes


@pytest.fixture(scope="module")
def finished(finished):
    assert main(["eval", str(finished), "--metrics", "psnr"]) == 0
    return finished


@pytest.fixture
def facts(capsys):
    def read(*words):
        capsys.readouterr()
        assert main(["info", *map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return read


def test_a_run_says_what_its_files_say(scene, finished, facts):
    info = facts(finished)
    header, arrays = load_checkpoint(finished / "checkpoint.npz")
    log = [json.loads(line) for line in (finished / "log.jsonl").read_text().splitlines()]
    assert info["preset"] == "tiny" and info["scene"] == scene and info["downscale"] == 2
    assert (info["step"], info["iterations"], info["finished"]) == (60, 60, True)
    initial, points_left = header["initial_points"], len(arrays["points.ids"])
    pruned = info["points"].pop("pruned")
    assert info["points"] == {"initial": initial, "left": points_left}
    assert (
        sorted(pruned, reverse=True) == pruned and pruned[-1] == points_left and pruned[0] < initial
    )
    whole, size = math.prod(header["grid"]["dims"]), (finished / "checkpoint.npz").stat().st_size
    bytes_of_point = 4 + 4 * 4 + 4 * 9 + 2 * 9 * 16
    assert info["cells"] == {
        "box": whole,
        "hull": initial,
        "left": points_left,
        "checkpoint_bytes": size,
        "box_bytes": size + (whole - points_left) * bytes_of_point,
    }
    assert info["work"] is None
    assert info["grid"]["dims"] == header["grid"]["dims"]
    # images are 24 pixels wide, at an angle of view of 0.7, from a distance of 4
    pixels = 12 / math.tan(0.35) * header["grid"]["voxel_size"] / 4
    assert info["grid"]["voxel_size_pixels"] == pytest.approx(pixels, rel=0.02)
    assert info["files"]["checkpoint.npz"] == (finished / "checkpoint.npz").stat().st_size
    assert info["device"] == log[-1]["device"] and info["seconds"] == log[-1]["seconds"]
    assert info["psnr"] == log[-2]["psnr"]
    assert info["metrics"] == json.loads((finished / "eval/metrics.json").read_text())["mean"]
    parameters = sum(a.size for name, a in arrays.items() if name.startswith("net."))
    assert info["network"] == {
        "widths": [16, 16, 16],
        "blocks": "single",
        "parameters": parameters,
    }


def test_work_is_what_a_view_and_a_step_compute(finished, facts, capsys, dev):
    work = facts(finished, "--work")["work"]
    run = load(finished, dev)
    counted = []
    for camera in evenly(run.cameras("train"), 8):
        result = run.renderer.forward(camera, run.gamma, until="weights")
        found, shown = (counts.sum() for counts in result.fragments())
        counted.append([found, found - shown, len(result.weights.visible)])
    fragments, dropped, drawn = np.mean(counted, 0)
    assert work["views"] == 8 and work["drawn"] == drawn
    assert work["fragments"] == {"found": fragments, "blended": fragments - dropped}
    # a crop covers the whole image, and each fragment has a gradient
    step = {"side": 24, "touched": drawn, "with_gradients": fragments - dropped}
    assert work["step"] == step and 0 < dropped < fragments
    network = work["network"]
    assert 0 < network["tiles"] < 1 and network["whole"] == network["multiplications"]
    side = 24 + 2 * MARGIN
    assert network["whole"] == multiplications(run.model.net.layers, side, side)
    assert main(["info", str(finished), "--work"]) == 0
    text = capsys.readouterr().out
    assert f"{fragments:.0f} fragments, {1 - dropped / fragments:.1%} of them blended" in text
    assert "--work: only of a run" in failure("info", "demo", "--work")


def test_an_unfinished_run_and_one_without_a_checkpoint(scene, tmp_path, facts, monkeypatch):
    train_and_interrupt(scene, tmp_path / "run", 25, monkeypatch)
    info = facts(tmp_path / "run")
    assert (info["step"], info["finished"], info["metrics"]) == (20, False, None)
    train_and_interrupt(scene, tmp_path / "young", 7, monkeypatch)
    info = facts(tmp_path / "young")
    assert info["step"] == 0 and info["points"] is None and info["seconds"] > 0
    assert main(["info", str(tmp_path / "young")]) == 0


def test_a_run_whose_scene_was_renamed(scene, finished, tmp_path, facts):
    run, old, new = tmp_path / "run", tmp_path / "ball", tmp_path / "sphere"
    shutil.copytree(scene, old)
    assert main(arguments(str(old), run, train__iterations=6)) == 0
    before = facts(run)
    assert main(["eval", str(run), "--metrics", "psnr"]) == 0
    metrics = json.loads((run / "eval" / "metrics.json").read_text())
    old.rename(new)
    assert facts(run)["grid"] == before["grid"]
    assert f"{old}: the run's scene is missing; say where it is with --scene" in failure(
        "eval", run
    )
    sheet = ("--picture", tmp_path / "points.png")
    assert facts(run, "--scene", new)["grid"] == before["grid"]
    assert facts(run, "--scene", new, *sheet)["picture"] == str(tmp_path / "points.png")
    assert main(["eval", str(run), "--metrics", "psnr", "--scene", str(new)]) == 0
    again = json.loads((run / "eval" / "metrics.json").read_text())
    assert again["per_image"] == metrics["per_image"]


def test_a_scene_says_what_is_in_it(scene, facts):
    info = facts(scene)
    assert info["format"] == "transforms" and list(info["splits"].items()) == [
        ("train", 8),
        ("test", 2),
    ]
    assert info["images"] == {"48x48": 10} and info["downscale"] == 1
    focal = 24 / math.tan(0.35)
    assert info["focal_pixels"] == pytest.approx([focal, focal])
    assert info["field_of_view"]["x"] == pytest.approx([math.degrees(0.7)] * 2)
    share = np.pi * (BALL / math.sqrt(16 - BALL**2) * focal) ** 2 / 48**2
    share = pytest.approx(share, rel=0.02)
    agreeing = {"disagreeing": [], "left_out": {}, "forgiven": 0}
    assert info["masks"] == {"with_alpha": 1.0, "object": share, **agreeing}
    assert info["hull"]["refinements"] == 0
    assert info["depth_range"] is None and info["problem"] is None
    assert info["distances"] == pytest.approx([4, 4], abs=1e-6)
    assert info["looked_at"] == pytest.approx([0, 0, 0], abs=1e-6)
    assert info["up"] == pytest.approx([0, 0, 1], abs=1e-3)
    hull = info["hull"]
    assert 250_000 <= hull["points"] <= 255_000 and not hull["capped"]
    low, high = np.array(hull["box"])
    assert (low < -0.9 * BALL).all() and (high > 0.9 * BALL).all()
    assert (np.abs(hull["box"]) < 1.5 * BALL).all()


def test_a_scene_without_hull_has_an_image(tmp_path, facts, capsys):
    scene = Path(write_ball_scene(tmp_path / "ball", views=5))
    *others, last = (scene / "train").iterdir()
    pixels = np.array(Image.open(last))
    pixels[..., 3] = 0
    pixels[2:5, 2:5, 3] = 255
    Image.fromarray(pixels).save(last)
    words = ["info", str(scene), "--picture", str(tmp_path / "sheet.png")]
    assert main([*words, "--json"]) == 2, "as a training, which says the same"
    told = capsys.readouterr()
    info = json.loads(told.out)
    assert info["hull"] is None and "the mask rejects every place" in info["problem"]
    assert info["problem"] in told.err
    image = read_rgba(tmp_path / "sheet.png")[..., :3]
    assert not (image == OUTLINE).all(-1).any()
    assert main(["info", str(scene)]) == 2
    assert "hull        none: " in capsys.readouterr().out
    for path in (*others, last):
        Image.open(path).convert("RGB").save(path)
    info = facts(scene, "--picture", tmp_path / "sheet.png")
    assert info["masks"]["with_alpha"] == 0 and info["masks"]["object"] is None
    assert info["hull"]["points"] > 0, "they fill a box"
    assert read_rgba(tmp_path / "sheet.png").shape[1] >= 4 * 48


def test_small_units_have_their_digits(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "ball")
    for file in (tmp_path / "ball").glob("*.json"):
        data = json.loads(file.read_text())
        for frame in data["frames"]:
            frame["transform_matrix"] = (
                np.array(frame["transform_matrix"]) * [1, 1, 1, 1e-6]
            ).tolist()
            frame["transform_matrix"][3] = [0, 0, 0, 1]
        file.write_text(json.dumps(data))
    assert main(["info", scene]) == 0
    assert "cameras     0.000004000 from" in capsys.readouterr().out
