"""tools/sparse_tiles.py: the rows it prints are measurements of the run, and bad input is told."""

import json

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main as pp_cl
from tools.sparse_tiles import main

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps on a ball in large pictures."""
    folder = tmp_path_factory.mktemp("sparse_tiles")
    scene = write_ball_scene(folder / "ball", size=300)
    changes = {"points__count": 1500, "train__iterations": 2, "train__crop": 28}
    assert pp_cl(arguments(scene, folder / "run", 1, network__widths="16,16,16", **changes)) == 0
    return folder / "run"


def test_rows(run, tmp_path, capsys):
    file = tmp_path / "a.json"
    assert main([str(run), "--views", "2", "--runs", "1", "--json", str(file)]) == 0
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
    words = ["--views", "1", "--runs", "1", "--downscale", "2", "--widths", "16,16,32"]
    assert main([str(run), *words]) == 0


@pytest.mark.parametrize("words", [["--views", "0"], ["--widths", "3"]])
def test_bad_input(tmp_path, capsys, words):
    with pytest.raises(SystemExit):
        main([str(tmp_path), *words])
    assert words[0] in capsys.readouterr().err


def test_a_missing_run(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
