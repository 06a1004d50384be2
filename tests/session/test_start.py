import pytest
from PIL import Image
from support.runs import spoken
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.config import load_config, run_config
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.hull import spacing_pixels
from pp_cl.scene.load import open_scene
from pp_cl.scene.verdict import judged
from pp_cl.session.decide import COARSEST, FINEST, TWICE, as_decided, first_hull
from pp_cl.session.training import open_training


@pytest.mark.parametrize(
    "points, radius",
    [(4000, 0.85), (25_000, pytest.approx(0.92, abs=0.01)), (250_000, 1.15)],
    ids=["coarse", "between", "dense"],
)
def test_an_open_radius_is_a_pixel_within_bounds(tmp_path, points, radius):
    """config.json holds it, so the run and its resume use the same radius."""
    scene, out = write_ball_scene(tmp_path / "ball", views=8, size=64), tmp_path / "run"
    words = ["train", scene, "--out", out, "--points", str(points), "--iterations", "1"]
    assert spoken(words)[0] == 0
    assert load_config(out / "config.json").raster.radius == radius


@pytest.mark.parametrize(
    "key, value, times",
    [("train.minutes", 1e-3 * TWICE, 1), ("train.minutes", 40 * TWICE, 2), ("train.seed", 1, 2)],
)
def test_a_second_refinement_is_planned_where_it_will_pay(dev, tmp_path, key, value, times):
    """With one, points begin as much closer."""
    scene = write_ball_scene(tmp_path / "ball", views=8, size=192)
    given = [("points.count", 600, "test"), ("scene.downscale", 1, "test"), (key, value, "test")]
    config = run_config(RunFolder(tmp_path / "a"), scene, "tiny", given)
    views = open_scene(dev, config, ("train",)).splits["train"]
    hull, shares = first_hull(dev, config, judged(dev, config, views)[0])
    spacing = spacing_pixels(hull.grid, [view.camera for view in views]) / 2**times
    assert sum(0 < share < 1 for share in shares) == times
    assert 0.9 * FINEST < spacing < 1.1 * COARSEST


@pytest.mark.parametrize("wrong, opacity", [(0, "on"), (4, "off")])
def test_opacity_has_no_direction_where_masks_contradict(tmp_path, capsys, wrong, opacity):
    """Such an opacity would learn the wrong mask of each view."""
    scene, out = write_ball_scene(tmp_path / "ball", views=24), tmp_path / "run"
    for number in range(0, 6 * wrong, 6):
        file = tmp_path / f"ball/train/r_{number}.png"
        with Image.open(file) as image:
            image.paste((0, 0, 0, 0), (24, 18, 48, 30))
            image.save(file)
    words = ["train", scene, "--out", str(out), "--points", "4000", "--iterations", "1"]
    assert main(words) == 0
    assert ("masks: they contradict each other" in capsys.readouterr().out) == (wrong > 0)
    assert load_config(out / "config.json").train.view_opacity == opacity


def test_a_further_member_begins_with_the_points_of_the_first(dev, tmp_path):
    """It has the refinements that the first has chosen, with the points that these need."""
    scene, counts = write_ball_scene(tmp_path / "ball", views=8, size=128), []
    given = [("points.count", 3000, "test"), ("scene.downscale", 1, "test")]
    config = run_config(RunFolder(tmp_path / "a"), scene, "tiny", given)
    for name in "ab":
        training = open_training(dev, RunFolder(tmp_path / name), config, None)
        counts.append(training.trainer.model.cloud.count)
        config = as_decided(config, training.config)
    assert counts[0] == counts[1] > 1.1 * 3000


def test_settings_never_change(dev, tmp_path, scene):
    """A training records its decisions in a copy of the settings, which config.json holds."""
    folder, given = RunFolder(tmp_path / "run"), [("points.count", 500, "test")]
    config = run_config(folder, scene, "tiny", [*given, ("train.iterations", 2, "test")])
    asked, chosen = config.to_json(), open_training(dev, folder, config, None)
    assert config.to_json() == asked and config.raster.radius == 0
    chosen.run()
    assert load_config(folder.config) == chosen.config != config
    assert chosen.trainer.config == chosen.config
    assert as_decided(config, chosen.config) == chosen.config and chosen.config.raster.radius > 0
