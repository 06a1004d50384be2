import pytest
from support.runs import spoken
from support.scenes import write_ball_scene

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
