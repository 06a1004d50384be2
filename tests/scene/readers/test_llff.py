import numpy as np
import pytest
from support.same_scene import held_out, views
from support.transforms_scenes import left_out, refused

from pp_cl.files.image import write_png
from pp_cl.scene.readers.llff import read_split
from tools.scene_formats import llff

FILE = "poses_bounds.npy"


def test_axes_are_down_right_and_back(tmp_path):
    """A camera at (0, 0, 5) looks along -z with x to the right. Its axes, given in world
    coordinates, are down (0, -1, 0), right (1, 0, 0) and back (0, 0, 1).
    """
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "a.JPG.png", np.zeros((22, 30, 3)))
    pose = np.array([[0, 1, 0, 0, 22], [-1, 0, 0, 0, 30], [0, 0, 1, 5, 40.0]])
    np.save(tmp_path / FILE, np.append(pose.ravel(), [1, 9])[None])
    [image_file] = read_split(tmp_path, "test", [])
    camera = image_file.camera
    right, down, depth = camera.pose[:, :3].T @ (np.array([0.3, 0.2, 1]) - camera.eye)
    np.testing.assert_allclose((right, down, depth), (0.3, -0.2, 4), atol=1e-12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 40, 15, 11)
    assert image_file.depth_range is None and image_file.mask is None


def cell(column, value):
    def changed(rows):
        rows[2, column] = value
        return rows

    return changed


BAD = {
    "a row is missing": (lambda rows: rows[1:], "11 images"),
    "15 columns": (lambda rows: rows[:, :15], "(11, 15)"),
    "focal length 0": (cell(14, 0), "row 2"),
    "another shape": (cell(4, 30), "row 2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_poses(tmp_path, case):
    change, word = BAD[case]
    llff.write(tmp_path, held_out(views(centred=True)))
    np.save(tmp_path / FILE, change(np.load(tmp_path / FILE)))
    check = left_out if word == "row 2" else refused
    check(tmp_path, tmp_path / FILE, word)
