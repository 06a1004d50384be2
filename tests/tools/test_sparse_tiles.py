"""tools/sparse_tiles.py: the rows it prints are measurements of the run, and bad input is told."""

import importlib.util
import json
from pathlib import Path

import pytest
from support.scenes import write_ball_scene

from pp_cl.cli import main

pytestmark = pytest.mark.slow

SPEC = importlib.util.spec_from_file_location(
    "sparse_tiles", Path(__file__).parents[2] / "tools" / "sparse_tiles.py"
)
TOOL = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(TOOL)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps on a ball in large pictures."""
    folder = tmp_path_factory.mktemp("sparse_tiles")
    scene = write_ball_scene(folder / "ball", size=300)
    assert (
        main(
            [
                "train",
                scene,
                "--out",
                str(folder / "run"),
                "--points",
                "1500",
                "--iterations",
                "2",
                "--downscale",
                "1",
                "--set",
                "train.crop=28",
                "--set",
                "network.widths=16,16,16",
            ]
        )
        == 0
    )
    return folder / "run"


def test_rows(run, tmp_path, capsys):
    file = tmp_path / "a.json"
    assert TOOL.main([str(run), "--views", "2", "--runs", "1", "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert len(rows) == 2
    for row in rows:
        assert row["size"] == [300, 300] and 0 < row["computed_fraction"] < 0.8
        assert row["forward_ratio"] == pytest.approx(
            row["forward_dense_ms"] / row["forward_sparse_ms"]
        )
        assert row["image_difference"] < 1e-6
        # tiles of background differ by one ulp, of which the SSIM's gradient makes 1e-5
        assert row["grad_features_difference"] < 1e-5
        assert row["grad_parameters_difference"] < 5e-6
    assert "of the multiplications remain" in capsys.readouterr().out
    assert (
        TOOL.main(
            [str(run), "--views", "1", "--runs", "1", "--downscale", "2", "--widths", "16,16,32"]
        )
        == 0
    )


def test_bad_input(run, capsys):
    assert TOOL.main([str(run), "--views", "0"]) == 2
    assert "--views" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        TOOL.main([str(run), "--widths", "3"])
    assert "--widths" in capsys.readouterr().err


def test_a_missing_run(tmp_path, capsys):
    assert TOOL.main([str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
