"""tools/paper_scale.py: it measures what it says, and bad input is one line."""

import importlib.util
from pathlib import Path

import pytest
from support.scenes import write_ball_scene

SPEC = importlib.util.spec_from_file_location(
    "paper_scale", Path(__file__).parents[2] / "tools" / "paper_scale.py"
)
TOOL = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(TOOL)


@pytest.mark.parametrize("ways", [[], ["--lazy"]])
def test_a_small_scene(tmp_path, capsys, ways):
    scene = write_ball_scene(tmp_path / "ball", size=40)
    assert TOOL.main([scene, "--points", "1500", "--views", "2", "--rounds", "1", *ways]) == 0
    first, second = capsys.readouterr().out.splitlines()[-2:]
    assert 1500 <= int(first.split()[0]) < 1600 and "shaded" in first
    assert [w for w in second.split() if w.isalpha() and w != "ms"] == [
        "project",
        "pairs",
        "weights",
        "shade",
        "blend",
        "gradients",
        "update",
        "forward",
    ]


def test_bad_input(tmp_path, capsys):
    assert TOOL.main([str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
    assert TOOL.main([str(tmp_path), "--views", "0"]) == 2
    assert "--views" in capsys.readouterr().err
