import json

import numpy as np
import pytest
from support.scenes import ring_cameras

from pp_cl.errors import UserError
from pp_cl.scene.readers.camera_file import read_cameras, read_rate

CAMERAS = ring_cameras(3, 64)
TO_GL = np.diag([1, -1, -1, 1])


def written(folder, content):
    path = folder / "cameras.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def world(camera):
    return (np.vstack([camera.pose, [0, 0, 0, 1]]) @ TO_GL).tolist()


def splatting(camera):
    return {
        "id": 0,
        "img_name": "a",
        "width": camera.width,
        "height": camera.height,
        "position": camera.eye.tolist(),
        "rotation": camera.pose[:, :3].tolist(),
        "fx": camera.fx,
        "fy": camera.fy,
    }


def path_camera(camera):
    """A camera in nerfstudio's camera_path; fov is the angle across the height."""
    fov = np.degrees(2 * np.arctan(0.5 * camera.height / camera.fy))
    return {"camera_to_world": np.ravel(world(camera)).tolist(), "fov": fov, "aspect": 1}


CONTENTS = {
    "cameras.json": [splatting(camera) for camera in CAMERAS],
    "transforms.json": {
        "fl_x": CAMERAS[0].fx,
        "w": 64,
        "h": 64,
        "frames": [{"file_path": "no/such.png", "transform_matrix": world(c)} for c in CAMERAS],
    },
    "camera_path.json": {
        "camera_type": "perspective",
        "render_width": 64,
        "render_height": 64,
        "camera_path": [path_camera(camera) for camera in CAMERAS],
    },
}


def test_a_path_states_its_rate(tmp_path):
    file, content = tmp_path / "path.json", CONTENTS["camera_path.json"]
    for rate, expected in ((24, 24.0), (None, None), ("24", None), (-1, None)):
        file.write_text(json.dumps(content | {"fps": rate}))
        assert read_rate(file) == expected
    file.write_text(json.dumps(content | {"crop": {"crop_scale": [1, 1, 1]}}))
    with pytest.warns(UserWarning, match="its crop is not read"):
        read_cameras(file)
    assert read_rate(tmp_path / "none.json") is None


@pytest.mark.parametrize("name", CONTENTS)
def test_cameras_are_read(tmp_path, name):
    read = read_cameras(written(tmp_path, CONTENTS[name]))
    assert len(read) == 3
    for got, camera in zip(read, CAMERAS, strict=True):
        np.testing.assert_allclose(got.pose, camera.pose, atol=1e-9)
        intrinsics = (got.fx, got.fy, got.cx, got.cy, got.width, got.height)
        assert intrinsics == pytest.approx((camera.fx, camera.fy, 32, 32, 64, 64))


def test_a_size_is_taken_from_the_command_where_the_file_has_none(tmp_path):
    content = {"camera_angle_x": 0.7, "frames": [{"transform_matrix": world(CAMERAS[0])}]}
    (camera,) = read_cameras(written(tmp_path, content), (80, 40))
    assert (camera.width, camera.height) == (80, 40)
    assert camera.fx == pytest.approx(40 / np.tan(0.35))
    with pytest.raises(UserError, match="frames.0.*w: is missing; add it, or give --size"):
        read_cameras(written(tmp_path, content))


def changed(name, key, value):
    content = json.loads(json.dumps(CONTENTS[name]))
    listed = content if isinstance(content, list) else content.get("frames", ())
    listed = listed or content["camera_path"]
    listed[1][key] = value
    return content


@pytest.mark.parametrize(
    "content, named",
    [
        ("[]", "must hold at least one camera"),
        ("3", "holds no cameras"),
        ({"camera_path": [7]}, r"camera_path\[0\]: must be a JSON object"),
        (changed("cameras.json", "position", [1, 2]), r"\[1\].position"),
        (changed("cameras.json", "rotation", [[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "no rotation"),
        (changed("cameras.json", "fx", None), "fx: is missing"),
        (changed("cameras.json", "height", 1e9), "height"),
        (changed("camera_path.json", "fov", None), "fov: is missing"),
        (changed("camera_path.json", "fov", 200), "fov"),
        (changed("camera_path.json", "camera_type", "fisheye"), "camera_type"),
        (changed("transforms.json", "latlong", True), "latlong"),
        (changed("camera_path.json", "camera_to_world", [1] * 15), "camera_to_world"),
        (changed("transforms.json", "k4", 0.1), "undistort"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, content, named):
    path = written(tmp_path, content)
    with pytest.raises(UserError, match=f"^{path}: .*{named}"):
        read_cameras(path)
