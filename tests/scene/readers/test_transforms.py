import json
import math
import os

import numpy as np
import pytest
from support.transforms_scenes import SIZE, left_out, opengl_pose, refused, train_views, write_scene

from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene.lens import LensDistortion
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers import transforms


def test_views_and_names(tmp_path, capfd):
    write_scene(tmp_path)
    write_scene(tmp_path, "test", count=2)
    scene = load_scene(tmp_path, ("train", "test"))
    assert scene.name == tmp_path.name and scene.folder == tmp_path
    assert [v.name for v in scene.splits["train"]] == ["train_0.png", "train_1.png", "train_2.png"]
    assert [v.name for v in scene.splits["test"]] == ["test_0.png", "test_1.png"]
    for view in scene.splits["train"] + scene.splits["test"]:
        assert np.array_equal(view.image, read_rgba(tmp_path / view.name))
        assert (view.camera.width, view.camera.height) == SIZE
    assert list(load_scene(str(tmp_path)).splits) == ["train"]
    assert capfd.readouterr().err == "", "a progress bar without a terminal"


def test_projection_follows_opengl(tmp_path, rng):
    """The format's own rules (y up, looking along -z) give the pixel of a world point."""
    data = write_scene(tmp_path)
    focal = 0.5 * SIZE[0] / math.tan(0.35)
    for frame, view in zip(data["frames"], load_scene(tmp_path).splits["train"], strict=True):
        point = rng.normal(size=3) * 0.3
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ [*point, 1]
        expected = [SIZE[0] / 2 + focal * x / -z, SIZE[1] / 2 - focal * y / -z]
        *pixel, depth = view.camera.project(point)
        assert depth > 0 and np.allclose(pixel, expected, rtol=0, atol=1e-9)


def test_nerfstudio_names(tmp_path):
    """A frame's own keys override the file's."""

    def edit(data):
        data.update(
            fl_x=31.0, fl_y=32.5, cx=11.25, cy=8.5, w=SIZE[0], h=float(SIZE[1]), near=2.0, far=5
        )
        data.update(k1=0, p2=0.0, camera_model="OPENCV")
        data["frames"][1].update(fl_x=33.0, cy=0, near=1.5, far=None)

    write_scene(tmp_path, edit=edit)
    scene = load_scene(tmp_path)
    got = [
        [v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy, *v.depth_range]
        for v in scene.splits["train"]
    ]
    assert got == [
        [31, 32.5, 11.25, 8.5, 2, 5],
        [33, 32.5, 11.25, 0, 1.5, 5],
        [31, 32.5, 11.25, 8.5, 2, 5],
    ]


def test_an_image_that_is_turned(tmp_path):
    """Without an EXIF orientation, the direction of the turn is unknown."""
    write_scene(tmp_path, edit=lambda data: data.update(w=SIZE[1], h=SIZE[0]))
    refused(tmp_path, tmp_path / "transforms_train.json", "w: is for", "turned", "upright")


def test_angles_of_images_that_were_reduced(tmp_path):
    """Angles stay; tests/scene/readers/test_common.py tests values in pixels, which are scaled."""
    camera = train_views(tmp_path, w=2 * SIZE[0], h=2 * SIZE[1])[0].camera
    assert camera.fx == pytest.approx(0.5 * SIZE[0] / math.tan(0.35))
    assert (camera.cx, camera.cy) == (SIZE[0] / 2, SIZE[1] / 2)


@pytest.mark.parametrize("ending", (".JPG", ".jpeg", ".webp"))
def test_a_path_without_the_ending_of_its_image(tmp_path, ending):
    data = write_scene(tmp_path)
    (tmp_path / "train_1.png").rename(tmp_path / f"train_1{ending}")
    data["frames"][0]["file_path"] = r".\train_0.png"
    data |= {"train_filenames": [r".\train_0.png", f"train_1{ending}"]}
    (tmp_path / "transforms_train.json").unlink()
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    names = [view.name for view in load_scene(tmp_path).splits["train"]]
    assert names == ["train_0.png", f"train_1{ending}"]


@pytest.mark.parametrize("corners", [[0, 1], [[0, 0, 0], [1, 1, 0]], [["a"] * 3] * 2, [[0] * 3]])
def test_the_box_of_a_single_file(tmp_path, corners):
    data, file = write_scene(tmp_path), tmp_path / "transforms.json"
    (tmp_path / "transforms_train.json").rename(file)
    assert transforms.box(tmp_path) is None
    file.write_text(json.dumps(data | {"aabb": [[-1, -2, -3], [1, 2, 4]]}))
    np.testing.assert_array_equal(transforms.box(tmp_path), [[-1, -2, -3], [1, 2, 4]])
    file.write_text(json.dumps(data | {"aabb": corners}))
    with pytest.raises(UserError, match=f"^{file}: aabb: "):
        transforms.box(tmp_path)


def test_angle_of_height_and_single_focal_length(tmp_path):
    camera = train_views(tmp_path, camera_angle_y=0.5)[0].camera
    assert camera.fy == 0.5 * SIZE[1] / math.tan(0.25) != camera.fx
    camera = train_views(tmp_path, fl_x=40)[0].camera
    assert camera.fx == camera.fy == 40


def test_rows_and_rounding_of_the_pose(tmp_path, rng):
    exact = opengl_pose([1, 2, 0.5])
    rough, scaled = exact.copy(), exact * [3.7, 3.7, 3.7, 1]
    rough[:3, :3] += rng.uniform(-1e-4, 1e-4, (3, 3))
    for matrix in (exact[:3], rough, scaled):
        pose = train_views(tmp_path, transform_matrix=matrix.tolist())[0].camera.pose
        rotation = pose[:, :3]
        assert (
            np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-14 and np.linalg.det(rotation) > 0
        )
        assert np.abs(rotation - exact[:3, :3] * [1, -1, -1]).max() < 2e-4
        assert np.array_equal(pose[:, 3], exact[:3, 3])


MATRIX = opengl_pose([3, 0, 1])
BAD_FRAMES = {
    "no path": ("file_path", None),
    "a number as path": ("file_path", 7),
    "no such image": ("file_path", "./train_9"),
    "an image twice": ("file_path", "train_0.png"),
    "no matrix": ("transform_matrix", None),
    "NaN": ("transform_matrix", np.where(np.eye(4) == 1, np.nan, MATRIX).tolist()),
    "scaled": ("transform_matrix", (MATRIX * [1.01, 1.01, 1.05, 1]).tolist()),
    "negative focal length": ("fl_x", -5),
    "NaN number": ("cx", math.nan),
    "huge number": ("fl_y", 10**400),
    "angle over pi": ("camera_angle_x", 40),
    "width": ("w", 48),
    "distortion": ("k4", 0.01),
    "panorama": ("camera_model", "EQUIRECTANGULAR"),
    "fisheye of instant-ngp": ("ftheta_p0", 0.1),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_bad_frame(tmp_path, case):
    key, value = BAD_FRAMES[case]
    write_scene(tmp_path, edit=lambda data: data["frames"][1].update({key: value}))
    refused(tmp_path, tmp_path / "transforms_train.json", f"frames[1].{key}:")


@pytest.mark.parametrize(
    ("near", "far", "key"), ((1.0, None, "far"), (None, 1.0, "near"), (3, 2, "far"))
)
def test_a_bad_depth_range(tmp_path, near, far, key):
    write_scene(tmp_path, edit=lambda data: data["frames"][1].update(near=near, far=far))
    refused(tmp_path, f"transforms_train.json: frames[1].{key}:")


@pytest.mark.parametrize(
    ("change", "place"),
    (
        ({"camera_angle_x": "wide"}, "camera_angle_x:"),
        ({"camera_angle_x": None}, "frames[0].fl_x:"),
        ({"frames": []}, "frames:"),
        ({"frames": "all"}, "frames:"),
        ({"frames": [[1, 2]]}, "frames[0].file_path:"),
    ),
)
def test_bad_keys_of_the_whole_file(tmp_path, change, place):
    write_scene(tmp_path, edit=lambda data: data.update(change))
    refused(tmp_path, f"{tmp_path / 'transforms_train.json'}: {place}")


@pytest.mark.parametrize(
    ("text", "words"),
    (
        ('{\n "frames": [,]\n}', ("line 2", "column 13")),
        ("[1, 2]", ("object",)),
        ("[" * 100_000, ("JSON",)),
    ),
)
def test_broken_json(tmp_path, text, words):
    (tmp_path / "transforms_train.json").write_text(text, errors="surrogateescape")
    refused(tmp_path, tmp_path / "transforms_train.json", *words)


def test_a_copy_beside_transforms_json_is_no_split(tmp_path):
    write_scene(tmp_path)
    (tmp_path / "transforms_train.json").rename(tmp_path / "transforms.json")
    (tmp_path / "transforms_backup.json").write_text("{}")
    assert transforms.splits(tmp_path) == ["test", "train"]
    assert len(load_scene(tmp_path).splits["train"]) == 2


def test_what_is_perspective_by_its_keys_is_read_and_motion_is_told(tmp_path):
    keys = {"is_fisheye": False, "camera_type": "perspective", "orthographic": None}

    def edit(data):
        for i, frame in enumerate(data["frames"]):
            frame.update(keys, time=i / 2)

    write_scene(tmp_path, edit=edit)
    with pytest.warns(UserWarning, match="motion is not modelled"):
        assert len(load_scene(tmp_path).splits["train"]) == 3


@pytest.mark.parametrize("keys", ({"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}))
def test_fisheyes_of_nerfstudio_and_colmap2nerf(tmp_path, keys):
    """colmap2nerf writes the tangential coefficients, too, as zeros."""
    keys |= {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "p1": 0, "p2": 0}
    write_scene(tmp_path, edit=lambda data: data.update(keys))
    [view, *_] = transforms.read_split(tmp_path, "train", [])
    assert view.lens == LensDistortion(k1=0.1, k2=0.2, k3=0.3, k4=0.4, fisheye=True)
    write_scene(tmp_path, edit=lambda data: data.update(keys, p2=0.1))
    refused(tmp_path, tmp_path / "transforms_train.json", "p2:")


@pytest.mark.unix
def test_a_pipe_is_no_file_of_cameras(tmp_path):
    write_scene(tmp_path)
    os.mkfifo(tmp_path / "transforms_val.json")
    assert "val" not in transforms.splits(tmp_path)
    (tmp_path / "transforms_train.json").unlink()
    os.mkfifo(tmp_path / "transforms_train.json")
    refused(tmp_path, tmp_path, "no scene in it")


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda frames: frames[2].update(file_path=None), "frames[2].file_path: is missing"),
        (lambda frames: frames.__setitem__(2, "none"), "frames[2].file_path: is missing"),
        (lambda frames: frames[2].update(near=1.0), "frames[2].far: near and far must both"),
    ],
)
def test_a_frame_that_is_wrong_costs_its_view(tmp_path, change, told):
    write_scene(tmp_path, count=10, edit=lambda data: change(data["frames"]))
    left_out(tmp_path, told)
    with pytest.warns(UserWarning, match="1 of 10 views left out"):
        assert len(load_scene(tmp_path).splits["train"]) == 9
