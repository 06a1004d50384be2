"""A training of the demo, and a step without the network: they measure what they say."""

import pytest
from support.scenes import write_ball_scene

from pp_cl.bench import training
from pp_cl.bench.training import FORWARD, bench_demo, bench_step
from pp_cl.config import assign, preset


@pytest.mark.slow
def test_a_training_of_the_demo(dev, monkeypatch):
    """As few steps as there may be: the curve ends with the training, the stages of a frame are
    among those of a step.
    """
    monkeypatch.setattr(training, "LEAST_STEPS", 8)
    found = bench_demo(dev, 0.0)
    assert found["steps"] == 8 and found["curve"][-1]["step"] == 8
    seconds = [row["seconds"] for row in found["curve"]]
    assert seconds == sorted(seconds) and seconds[0] > 0
    assert all(5 < row["psnr"] < 40 for row in found["curve"])
    assert set(found["frame_ms"]) == {*FORWARD, "network"}
    assert set(found["frame_ms"]) | {"network backward", "update"} <= set(found["step_ms"])
    for row in (*found["step_ms"].values(), *found["frame_ms"].values()):
        assert 0 < row["least"] <= row["ms"] <= row["most"]


def test_a_step_on_a_small_scene(dev, tmp_path):
    config = preset("paper")
    assign(config, "scene.path", write_ball_scene(tmp_path / "ball", size=40), "test")
    assign(config, "points.count", 1500, "test")
    row = bench_step(dev, config, views=2, rounds=1)
    assert 1500 <= row["points"] < 1600
    assert 0 < row["shaded"] <= 1
    assert row["pairs"] > row["points"]
    assert row["size"] == (40, 40)
    assert list(row["stages_ms"]) == [*FORWARD, "backward", "update"]
    assert row["forward_ms"] == pytest.approx(sum(row["stages_ms"][name] for name in FORWARD))
    assert row["peak_device_bytes"] > 1500 * 4 * 145
