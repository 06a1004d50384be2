from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.ball_views import CENTRE, RADIUS, ball_views
from support.checkpoints import load_checkpoint
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.commands.info_facts import describe_scene
from pp_cl.files.image import read_rgba, write_png
from pp_cl.scene.agreement import disagreements
from pp_cl.scene.hull import agreeing, build_grid, contradicting
from pp_cl.scene.outline import REJECTED, outline_sheet

BOX = np.stack([CENTRE - RADIUS, CENTRE + RADIUS])


def shifted(view, share):
    image = view.image.copy()
    image[..., 3] = np.roll(image[..., 3], round(share * image.shape[1]), axis=1)
    return replace(view, image=image)


@pytest.mark.parametrize("count", [8, 24, 60])
def test_masks_of_one_object_agree(count):
    assert disagreements(ball_views(count), BOX) == []


def test_a_hull_of_one_point_is_looked_at():
    assert disagreements(ball_views(8), np.stack([CENTRE, CENTRE])) == []


@pytest.mark.parametrize("count, bad", [(24, 0), (60, 5)])
def test_a_shifted_mask_is_named(dev, count, bad):
    views = ball_views(count)
    views[bad] = shifted(views[bad], 0.15)
    hull = build_grid(dev, views, 2000)
    [disagreement] = disagreements(views, hull.grid.box)
    assert disagreement.view is views[bad] and disagreement.share > 0.15


def bitten(view, share):
    image = view.image.copy()
    height, width = image.shape[:2]
    rows = slice(round((0.5 - share / 2) * height), round((0.5 + share / 2) * height))
    image[rows, width // 2 :, 3] = 0
    return replace(view, image=image)


def test_masks_that_agree_are_all_kept(dev):
    views = ball_views(60)
    assert agreeing(dev, views) == (views, {}, 0)


def test_masks_that_lie_elsewhere_are_left_out(dev):
    views = [view.reduced(2) for view in ball_views(60, (256, 256))]
    moved = {3: 0.06, 17: -0.06, 40: 0.2}
    for index, share in moved.items():
        views[index] = shifted(views[index], share)
    agreed, left_out, forgiven = agreeing(dev, views)
    assert set(left_out) == {views[index].name for index in moved} and forgiven == 0
    assert agreed == [view for index, view in enumerate(views) if index not in moved]
    assert max(left_out, key=left_out.get) == views[40].name


def test_a_hull_forgives_masks_that_lack_a_part(dev):
    views = ball_views(60)
    for index in (3, 17, 29, 40):
        views[index] = bitten(views[index], 0.25)
    agreed, left_out, forgiven = agreeing(dev, views)
    assert len(agreed) == 60 and not left_out and 0 < forgiven <= 4
    inside = CENTRE + 0.9 * RADIUS * directions(500)
    strict, forgiving = (build_grid(dev, views, 20_000, None, n) for n in (0, forgiven))
    lost, lost_less = (far_from(hull, inside) for hull in (strict, forgiving))
    assert lost.mean() > 0.2 > 2 * lost_less.mean()


def directions(count):
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def far_from(hull, places):
    """(P,) bool: True for places that have no vertex of the hull within two voxels."""
    distances, _ = cKDTree(hull.grid.positions(hull.ids)).query(places)
    return distances > 2 * hull.grid.voxel_size


def test_without_masks_nothing_disagrees():
    views = ball_views(12)
    views[0] = replace(views[0], image=np.full_like(views[0].image, 255))
    assert disagreements(views, BOX) == []


def wires(count):
    """Views of a cube's edges as wires, 1.5 pixels wide. A mask has all pixels that show them."""
    along = np.column_stack([np.linspace(-0.45, 0.45, 700), *np.zeros((2, 700))])
    ends = np.stack(np.meshgrid(0, (-0.45, 0.45), (-0.45, 0.45)), -1).reshape(-1, 1, 3)
    edges = np.concatenate([np.roll(along + ends, axis, -1) for axis in range(3)]).reshape(-1, 3)
    places = CENTRE + np.concatenate([edges + 0.012 * direction for direction in directions(8)])
    views = []
    for view in ball_views(count, (96, 96)):
        column, row, _ = view.camera.pixels(places)
        image = np.zeros_like(view.image)
        image[row, column] = 255
        views.append(replace(view, image=image))
    return views


def test_exact_masks_are_not_accused(dev):
    """Each view carves a little that no other does, but much of thin parts."""
    views = wires(60)
    agreement = agreeing(dev, views)
    hull = build_grid(dev, agreement.views, 20_000)
    assert disagreements(views, hull.grid.box)
    assert contradicting(views, hull, agreement) == []


def test_a_mask_that_lacks_a_part_is_named(dev):
    views = ball_views(60)
    views[3] = bitten(views[3], 0.25)
    agreement = agreeing(dev, views)
    hull = build_grid(dev, agreement.views, 20_000, None, agreement.forgiven)
    [disagreement] = contradicting(views, hull, agreement)
    assert disagreement.view is views[3] and not agreement.left_out


@pytest.fixture
def scene(tmp_path):
    folder = write_ball_scene(tmp_path / "ball", views=24, size=48)
    file = tmp_path / "ball/train/r_4.png"
    image = read_rgba(file)
    image[..., 3] = np.roll(image[..., 3], 8, axis=1)
    write_png(file, image)
    return folder


def test_the_scenes_facts_name_it_and_the_image_shows_it_first(dev, scene, tmp_path, capsys):
    facts, *shown = describe_scene(dev, scene, "tiny")
    [row] = facts["masks"]["disagreeing"]
    assert row["view"] == "train/r_4.png" and row["share"] > 0.15
    sheet, plain = outline_sheet(dev, *shown), outline_sheet(dev, *shown[:2])
    first = sheet[14 : 14 + 48, :48].astype(int)
    tinted = (first[..., 0] >= REJECTED[0]) & (first[..., 2] <= 127) & (first[..., 1] >= 60)
    assert tinted.sum() > 50
    assert sheet.shape == plain.shape and (sheet != plain).any()
    assert main(["info", scene, "--picture", str(tmp_path / "a.png")]) == 0
    assert "train/r_4.png: its mask rejects" in capsys.readouterr().out


def test_a_training_warns_leaves_the_image_and_goes_on_without(scene, tmp_path, capsys):
    for steps in (2, 4):
        words = arguments(scene, tmp_path / "run", 1, train__iterations=steps, points__count=500)
        assert main(words) == 0
        header, _ = load_checkpoint(tmp_path / "run" / "checkpoint.npz")
        assert header["left_out"] == ["train/r_4.png"] and len(header["views"]) == 24
    assert "left out of the training: train/r_4.png" in capsys.readouterr().err
    assert read_rgba(tmp_path / "run" / "masks.png").shape[1] > 48
