import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.viewing import tab, wait

from pp_cl.scene.listing import scene_frames
from pp_studio.view.scene_page import DROPPED, ScenePage, hull_points


@pytest.fixture
def folder(scene, tmp_path):
    shutil.copytree(scene, tmp_path / "ball")
    model = tmp_path / "ball" / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 48 48 60 60 24 24\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.png\n\n")
    rows = ("1 -.5 -.5 -.5 255 0 0 0.1", "2 .5 .5 .5 0 255 0 0.1", "3 90 0 0 9 9 9 0.1 1 1")
    (model / "points3D.txt").write_text("\n".join(rows))
    return tmp_path / "ball"


@pytest.fixture
def page(served, folder):
    return ScenePage(served[0], folder)


@pytest.fixture
def opened(page, served):
    with tab(served[1]) as opened_tab:
        yield opened_tab


def edits(folder):
    file = folder / "pp_cl.json"
    return json.loads(file.read_text()) if file.exists() else {}


def told(opened, words):
    opened.receive("GuiUpdateMessage", lambda m: words in str(m["updates"].get("_markdown")))


def test_cameras_points_and_a_suggested_box_are_shown(page, opened, folder):
    names = [view.name for split in ("train", "test") for view in scene_frames(folder, split)]
    frustums = [name for name, node in opened.nodes.items() if "fov" in node["props"]]
    assert frustums == [f"/views/{name}" for name in names] and len(names) == 10
    assert "10 of 10 views, box suggested" in page._status.content
    assert {"/points", "/box", "/corner 0", "/corner 1"} <= opened.nodes.keys()
    np.testing.assert_allclose(
        [corner.value for corner in page._corners], [[-0.48] * 3, [0.48] * 3], atol=0.01
    )
    page.fill()
    assert opened.receive("SceneNodeUpdateMessage", lambda m: m["updates"].get("_image_data"))


def test_a_view_of_two_splits_is_listed_once(served, folder):
    """The page's list raises an error in the browser if two items are equal."""
    shutil.copy(folder / "transforms_test.json", folder / "transforms_val.json")
    names = ScenePage(served[0], folder)._view.options
    assert len(names) == len(set(names)) == 10


def test_a_box_is_set_dragged_and_removed(page, opened, folder):
    opened.set("From", [-1, -1, -1])
    opened.set("To", [1, 1, 2])
    opened.set("Set", True)
    told(opened, "box given\n\nwritten to pp_cl.json")
    assert edits(folder) == {"box": [[-1, -1, -1], [1, 1, 2]]}
    place = page._space.page((-1, -1, -3)).tolist()
    names = {"name": "/corner 0", "owner": opened.nodes["/corner 0"].get("owner", "")}
    opened.send("TransformControlsDragStartMessage", **names)
    opened.send("TransformControlsUpdateMessage", wxyz=[1, 0, 0, 0], position=place, **names)
    opened.send("TransformControlsDragEndMessage", **names)
    wait(lambda: np.allclose(edits(folder)["box"], [[-1, -1, -3], [1, 1, 2]]))
    opened.set("Remove", True)
    told(opened, "box suggested\n\nwritten")
    assert edits(folder) == {}
    opened.set("From", [9, -1, -1])
    opened.set("Set", True)
    told(opened, "must be two corners")
    assert edits(folder) == {} and page._corners[0].value[0] < 0


def test_views_are_dropped_and_taken_back(page, opened, folder):
    opened.set("Name", "train/r_4.png")
    wait(lambda: page._view.value == "train/r_4.png")
    opened.set("Drop", True)
    told(opened, "9 of 10 views, box suggested\n\nwritten")
    assert edits(folder) == {"dropped": ["train/r_4.png"]} and page._drop.label == "Take back"
    assert tuple(page._frustums["train/r_4.png"].color) == DROPPED
    assert "train/r_4.png" not in [view.name for view in scene_frames(folder)]
    # what an editor wrote in the meantime stays
    (folder / "pp_cl.json").write_text('{"dropped": ["train/r_1.png", "train/r_4.png"]}')
    opened.set("Drop", True)
    wait(lambda: edits(folder) == {"dropped": ["train/r_1.png"]})
    opened.set("Keep all", True)
    told(opened, "10 of 10 views, box suggested\n\nwritten")
    assert edits(folder) == {}


def test_one_view_of_each_split_stays_and_a_broken_file(page, opened, folder):
    names = [view.name for view in scene_frames(folder)]
    (folder / "pp_cl.json").write_text(json.dumps({"dropped": names[1:]}))
    opened.set("Drop", True)
    told(opened, "no view of split train would be left")
    assert edits(folder) == {"dropped": names[1:]}
    (folder / "pp_cl.json").write_text("{")
    opened.set("Drop", True)
    told(opened, "pp_cl.json")
    assert (folder / "pp_cl.json").read_text() == "{"


def test_without_sparse_points_the_hull_is_shown(dev, served, scene):
    points = hull_points(None, scene)
    assert 15_000 < len(points) < 25_000
    assert 0.7 < np.linalg.norm(points, axis=1).max() < 1.2  # the ball has a radius of 0.8
    page = ScenePage(served[0], Path(scene))
    with tab(served[1]) as opened:
        assert "/points" not in opened.nodes
        page.fill()
        opened.receive("PointCloudMessage")
