import shutil

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.refused import failure
from support.runs import arguments, checkpoint, rows, train_and_interrupt

from pp_cl.cli import main
from pp_cl.config import preset
from pp_cl.engine.grid import Grid
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.training.prune import SPECK
from pp_cl.session.start import DEMO_NETWORK, begin_network


def test_a_run_learns_and_leaves_its_files(finished):
    log = rows(finished)
    assert [r["step"] for r in log] == [*range(5, 61, 5), 60] and log[-1]["finished"]
    losses = [r["loss"] for r in log[:-1]]
    assert np.mean(losses[-3:]) < 0.6 * losses[0]
    previews = {p.name for p in (finished / "previews").iterdir()}  # a slow device has one more
    assert {f"step_0000{n}.png" for n in (15, 30, 45, 60)} <= previews and len(previews) <= 5
    header, arrays = load_checkpoint(finished / "checkpoint.npz")
    assert header["finished"] and header["step"] == 60
    assert Grid.of_header(header["grid"]).in_large_parts(arrays["points.ids"], SPECK).all()
    assert 0 < len(arrays["points.ids"]) < header["initial_points"]
    assert not any(name.startswith(("moment", "state", "average")) for name in arrays)
    assert (np.diff(arrays["points.ids"].astype(np.int64)) > 0).all()
    assert arrays["points.offset"].any(axis=1).all() and arrays["points.offset"].std() > 0.01


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(scene, finished, tmp_path):
    assert main(arguments(scene, tmp_path / "again")) == 0
    assert checkpoint(tmp_path / "again") == checkpoint(finished)
    assert main(arguments(scene, tmp_path / "other", train__seed=1)) == 0
    assert checkpoint(tmp_path / "other") != checkpoint(finished)


@pytest.mark.parametrize("steps", [25, 59])
def test_stopped_at_any_step_it_resumes_to_the_same_bytes(
    scene, finished, tmp_path, monkeypatch, steps
):
    train_and_interrupt(scene, tmp_path / "run", steps, monkeypatch)
    assert main(arguments(scene, tmp_path / "run")) == 0
    assert checkpoint(tmp_path / "run") == checkpoint(finished)
    strip = [{k: v for k, v in r.items() if k != "seconds"} for r in rows(tmp_path / "run")]
    assert strip == [{k: v for k, v in r.items() if k != "seconds"} for r in rows(finished)]


def test_a_training_begins_with_the_network_of_another_run(scene, finished, tmp_path, monkeypatch):
    run, whole, other = tmp_path / "run", tmp_path / "whole", tmp_path / "other"
    shutil.copytree(finished, other)
    settings = {"network__rate": "1e-12,1e-12", "train__ema": "false"}
    assert main([*arguments(scene, whole, **settings), "--network", str(other)]) == 0
    _, expected = load_checkpoint(finished / "checkpoint.npz")
    _, arrays = load_checkpoint(whole / "checkpoint.npz")
    for name in (name for name in expected if name.startswith("net.")):
        np.testing.assert_allclose(arrays[name], expected[name], rtol=0, atol=1e-9)
    losses = [[r["loss"] for r in rows(out)[:5]] for out in (whole, finished)]
    assert np.mean(losses[0]) < 0.9 * np.mean(losses[1])

    train_and_interrupt(scene, run, 25, monkeypatch, **settings, network__start=other)
    shutil.rmtree(other)
    assert main(["train", "--out", str(run)]) == 0
    assert checkpoint(run) == checkpoint(whole)

    words = arguments(scene, tmp_path / "no", network__widths="16,16,32")
    assert "other/config.json: No such file" in failure(*words, "--network", other)
    error = failure(*words, "--network", finished)
    assert "has network.widths=16,16,16, this training 16,16,32" in error
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    "scene, widths, is_taken",
    [
        ("/mine", (32, 64, 128), True),
        ("demo", (32, 64, 128), False),
        ("/mine", (32, 64, 64), False),
    ],
)
def test_where_the_demos_network_is_taken(dev, scene, widths, is_taken):
    config = preset("tiny")
    config.scene.path, config.network.widths = scene, widths
    net = begin_network(dev, config)
    plain = UNet.of_settings(dev, config.network).parameters
    random = {name: dev.download(array) for name, array in plain.items()}
    with np.load(DEMO_NETWORK) as stored:
        for name, array in net.parameters.items():
            expected = stored[f"net.{name}"] if is_taken else random[name]
            np.testing.assert_array_equal(dev.download(array), expected)


def test_a_lower_degree_learns_what_zero_rates_above_it_learn(scene, tmp_path):
    lower, zero = tmp_path / "lower", tmp_path / "zero"
    assert main(arguments(scene, lower, points__sh_degree=0)) == 0
    assert main(arguments(scene, zero, train__sh_rate="0.5,0,0")) == 0
    _, arrays = load_checkpoint(lower / "checkpoint.npz")
    _, expected = load_checkpoint(zero / "checkpoint.npz")
    assert set(expected) - set(arrays) == {"points.sh1", "points.sh2"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, expected[name])


def test_bounded_memory_gives_the_same_bytes(scene, tmp_path, monkeypatch):
    """No buffer is larger than 200 bytes a point, and pruning in place takes many pieces."""
    changes = {"points__count": 50_000, "train__iterations": 24, "train__prune_every": 8}
    assert main(arguments(scene, tmp_path / "free", **changes)) == 0
    points = load_checkpoint(tmp_path / "free" / "checkpoint.npz")[0]["initial_points"]
    monkeypatch.setattr("pp_cl.engine.device.buffers.SCRATCH_BYTES", 100_000)
    monkeypatch.setenv("PP_MAX_ALLOCATION", str(200 * points / 2**20))
    assert main(arguments(scene, tmp_path / "bounded", **changes)) == 0
    assert checkpoint(tmp_path / "bounded") == checkpoint(tmp_path / "free")
    monkeypatch.setenv("PP_MAX_ALLOCATION", str(150 * points / 2**20))
    assert "at once" in failure(*arguments(scene, tmp_path / "smaller", **changes))
    assert not (tmp_path / "smaller").exists()
