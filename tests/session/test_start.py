import re

import pytest
from support.runs import arguments, spoken
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import load_config


@pytest.mark.parametrize(
    "points, radius",
    [(4000, 0.85), (25_000, pytest.approx(0.92, abs=0.01)), (250_000, 1.15)],
    ids=["coarse", "between", "dense"],
)
def test_an_open_radius_is_a_pixel_within_bounds(tmp_path, points, radius):
    """It is kept, so that the run and its resume have it."""
    scene, out = write_ball_scene(tmp_path / "ball", views=8, size=64), tmp_path / "run"
    words = ["train", scene, "--out", out, "--points", str(points), "--iterations", "1"]
    assert spoken(words)[0] == 0
    assert load_config(out / "config.json").raster.radius == radius


AUTOMATIC = {"points__count": 60, "train__refine_at": "0,0", "train__iterations": 30}


def test_too_little_memory_makes_the_finest_grid_coarser(tmp_path, capsys):
    """It is refined all the same: 60 points for ever are 11 pixels apart."""
    scene, told = write_ball_scene(tmp_path / "ball", size=96), []
    for name, gib in (("enough", 0), ("less", 0.03)):
        words = arguments(scene, tmp_path / name, 1, **AUTOMATIC, train__memory_gib=gib)
        assert main(words) == 0
        hull = re.search(r"(\S+) pixels apart, later (\S+), ", capsys.readouterr().out)
        told.append([float(pixels) for pixels in hull.groups()])
    assert told[0] == pytest.approx([3, 1.5], rel=0.05)
    assert 1.1 < told[1][1] / told[0][1] < 3
