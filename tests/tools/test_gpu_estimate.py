"""tools/gpu_estimate.py: its file is the one in docs, and its numbers those of stages and cards."""

import importlib.util
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("gpu_estimate", ROOT / "tools" / "gpu_estimate.py")
TOOL = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(TOOL)

STAGES = ["target", "project", "pairs", "weights", "shade", "blend", "network", "loss"]
STAGES += ["network backward", "backward", "update", "peaks", "step"]


def test_the_file_in_docs_is_up_to_date(tmp_path, capsys):
    assert TOOL.main(tmp_path / "x.json") == 0
    assert str(tmp_path / "x.json") in capsys.readouterr().out
    made, kept = (json.loads(path.read_text()) for path in (tmp_path / "x.json", TOOL.RESULTS))
    assert made | {"version": kept["version"]} == kept


def test_it_says_that_nobody_measured_it():
    results = json.loads(TOOL.RESULTS.read_text())
    assert "measured" not in results and "no card ran this" in results["estimated"]


def test_every_stage_of_both_presets():
    rows = TOOL.rows()
    assert [(row["preset"], row["stage"]) for row in rows] == [
        (preset, stage) for preset in ("paper", "tiny") for stage in STAGES
    ]
    for row in rows:
        assert all(row[card] > 0 for card in TOOL.CARDS)
        assert row["H200"] <= row["RX 7900 XTX"] <= row["Arc A770"]


@pytest.mark.parametrize("preset", ["paper", "tiny"])
def test_a_step_is_the_sum_of_its_stages(preset):
    *stages, step = (row for row in TOOL.rows() if row["preset"] == preset)
    assert step["launches"] == sum(row["launches"] for row in stages)
    for key in ("gigabytes", *TOOL.CARDS):
        assert step[key] == pytest.approx(sum(row[key] for row in stages), rel=0.01)


def test_a_stage_by_hand():
    """The network of the paper: 43 % of 966 thousand million multiply-adds at 66.9 TFLOP/s, in 18
    launches; the update: 2.67 million points of 1,428 bytes, 28 bytes of each of 4.04 million
    and seven times the network's, at 560 GB/s, in 29 launches.
    """
    rows = {(row["preset"], row["stage"]): row for row in TOOL.rows()}
    network, update = rows["paper", "network"], rows["paper", "update"]
    assert network["H200"] == pytest.approx(2 * 0.43 * 966.2e9 / 66.9e12 * 1e3 + 0.09, rel=0.01)
    moved = 2.665e6 * 1428 + 4.038e6 * 28 + 7 * 4 * 6.9e6
    assert update["Arc A770"] == pytest.approx(moved / 560e9 * 1e3 + 0.145, rel=0.01)
