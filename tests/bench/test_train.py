"""pp_cl/bench/train.py: it measures what it says."""

import pytest
from support.scenes import write_ball_scene

from pp_cl.bench.train import FORWARD, bench_train
from pp_cl.config import assign, preset


def test_a_small_scene(dev, tmp_path):
    config = preset("paper")
    for key, value in (
        ("scene.path", write_ball_scene(tmp_path / "ball", size=40)),
        ("points.count", 1500),
    ):
        assign(config, key, value, "test")
    row = bench_train(dev, config, views=2, rounds=1)
    assert 1500 <= row["points"] < 1600
    assert 0 < row["shaded"] <= 1
    assert row["pairs"] > row["points"]
    assert row["size"] == (40, 40)
    assert list(row["stages_ms"]) == [*FORWARD, "backward", "update"]
    assert row["forward_ms"] == pytest.approx(sum(row["stages_ms"][name] for name in FORWARD))
    assert row["peak_device_bytes"] > 1500 * 4 * 145
