"""The reader of LLFF's format."""

import io

import numpy as np
import pytest
from support.same_scene import held_out, same, views
from support.transforms_scenes import escape, refused

from pp_cl.files.image import write_png
from pp_cl.scene.readers.llff import read_split
from tools.scene_formats import llff

FILE = "poses_bounds.npy"


@pytest.fixture
def scene(tmp_path):
    llff.write(tmp_path, held_out(views(centred=True)))
    return tmp_path


def edit(folder, change):
    """change(rows) gives the rows to store."""
    np.save(folder / FILE, change(np.load(folder / FILE)))


# --------------------------------------------------------------------------------------------------


def test_axes_are_down_right_and_back(tmp_path):
    """A camera at (0, 0, 5) that looks along -z with x to the right: its axes in the world are
    down (0, -1, 0), right (1, 0, 0), back (0, 0, 1).
    """
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "a.JPG.png", np.zeros((22, 30, 3)))
    pose = np.array([[0, 1, 0, 0, 22], [-1, 0, 0, 0, 30], [0, 0, 1, 5, 40.0]])
    np.save(tmp_path / FILE, np.append(pose.ravel(), [1, 9])[None])
    [photograph] = read_split(tmp_path, "test")
    camera = photograph.camera
    right, down, depth = camera.pose[:, :3].T @ (np.array([0.3, 0.2, 1]) - camera.eye)
    np.testing.assert_allclose((right, down, depth), (0.3, -0.2, 4), atol=1e-12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 40, 15, 11)
    assert photograph.depth_range is None and photograph.mask is None


def test_images_smaller_than_the_poses_say(scene):
    """LLFF's own factor: the focal length shrinks with the images."""
    before = [p.camera.fx for p in read_split(scene, "train")]
    edit(scene, lambda rows: rows * np.where(np.isin(np.arange(17), (4, 9, 14)), 4, 1))
    after = [p.camera.fx for p in read_split(scene, "train")]
    np.testing.assert_allclose(before, after)


def test_masks_of_the_same_stem(scene):
    given = held_out(views(centred=True))
    same(scene, given)
    for file in (scene / "masks").iterdir():
        file.unlink()
    (scene / "masks").rmdir()
    assert read_split(scene, "train")[0].mask is None


# --------------------------------------------------------------------------------------------------


def cell(column, value):
    def changed(rows):
        rows[2, column] = value
        return rows

    return changed


BAD = {
    "a row is missing": (lambda rows: rows[1:], "(10, 17)", "11x17"),
    "15 columns": (lambda rows: rows[:, :15], "(11, 15)"),
    "one dimension": (lambda rows: rows.ravel(), "(187,)"),
    "NaN": (cell(3, np.nan), "NaN"),
    "huge": (cell(3, 1e31), "huge"),
    "focal length 0": (cell(14, 0), "row 2", "focal length 0"),
    "height below 0": (cell(4, -22), "row 2", "height -22"),
    "another shape": (cell(4, 30), "row 2", "another shape"),
    "no rotation": (cell(0, 9), "row 2", "no rotation"),
    "mirrored": (
        lambda rows: rows * np.where(np.isin(np.arange(17), (0, 5, 10)), -1, 1),
        "row 1",
        "no rotation",
    ),
    "text": (lambda rows: rows.astype(str), "no numbers"),
    "complex": (lambda rows: rows.astype(complex), "no numbers"),
    "objects": (lambda rows: rows.astype(object), "no numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_poses(scene, case):
    change, *words = BAD[case]
    edit(scene, change)
    refused(scene, scene / FILE, *words)


def claimed(shape):
    """A .npy file whose header claims a shape that it does not hold."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


@pytest.mark.parametrize(
    "content, word",
    [
        (b"", "cannot be read"),
        (b"\x93NUMPY\x01\0", "cannot be read"),
        (claimed((11, 17)), "too early"),
        (claimed((2**40, 2**20)), "claims the shape"),
        (b"\x93NUMPY\x09\0" + bytes(100), "cannot be read"),
    ],
    ids=["empty", "cut", "short", "a shape beyond all memory", "version"],
)
def test_a_broken_file(scene, content, word):
    (scene / FILE).write_bytes(content)
    refused(scene, scene / FILE, word)


def test_missing_images(scene):
    (scene / "images" / "000003.png").unlink()
    refused(scene, scene / FILE, "10 images")


def test_a_missing_mask(scene):
    (scene / "masks" / "000003.png").unlink()
    refused(scene, scene / "masks", "no mask 000003.png")


@pytest.mark.parametrize("name", ["images", "masks"])
def test_a_link_that_leaves_the_folder(scene, name):
    escape(scene / name / "000002.png")
    refused(scene, scene / name, "leaves the scene's folder")


def test_an_unknown_split(scene):
    refused(scene, "no split val", "test, train", splits=("val",))
