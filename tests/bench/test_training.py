"""A step without the network: it measures what it says."""

import pytest
from support.scenes import write_ball_scene

from pp_cl.bench.training import FORWARD, bench_step
from pp_cl.config import assign, preset


def test_a_step_on_a_small_scene(dev, tmp_path):
    config = preset("paper")
    assign(config, "scene.path", write_ball_scene(tmp_path / "ball", size=40), "test")
    assign(config, "points.count", 1500, "test")
    (row,) = bench_step(dev, config, views=2, rounds=1)
    assert 1500 <= row["points"] < 1600
    assert 0 < row["shaded"] <= row["points"]
    assert row["pairs"] > row["points"]
    assert row["size"] == 40
    assert list(row["stages_ms"]) == [*FORWARD, "backward", "update"]
    assert row["forward_ms"] == pytest.approx(sum(row["stages_ms"][name] for name in FORWARD))
    assert row["peak_device_bytes"] > 1500 * 4 * 145
