"""What a tab sends is read without trust."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import ring_cameras
from support.viewing import asking

from pp_cl.errors import UserError
from pp_cl.scene.readers.found import Notes
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.scene.readers.transforms import read_split
from pp_cl.view.messages import RANGES, packed, read_request

CAMERA = replace(ring_cameras(3, 48)[1], cx=20.5, fy=61.0, height=40)


def test_a_request_is_read_as_it_was_meant():
    request = read_request(json.dumps(asking(CAMERA, number=7, show="hits", kept=0.5, draft=True)))
    assert (request.number, request.show, request.kept, request.draft) == (7, "hits", 0.5, True)
    np.testing.assert_allclose(request.camera.pose, CAMERA.pose, atol=1e-15)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(request.camera, name) == getattr(CAMERA, name)


def test_a_copied_camera_is_a_frame_of_a_transforms_file(tmp_path):
    from PIL import Image

    Image.new("RGBA", (48, 40)).save(tmp_path / "a.png")
    frame = frame_keys(CAMERA) | {"file_path": "a.png"}
    (tmp_path / "transforms_train.json").write_text(json.dumps({"frames": [frame]}))
    [photograph] = read_split(tmp_path, "train", Notes())
    camera = photograph.camera
    np.testing.assert_allclose(camera.pose, CAMERA.pose, atol=1e-12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (CAMERA.fx, 61.0, 20.5, CAMERA.cy)


def with_matrix(row, column, value):
    facts = frame_keys(CAMERA)
    facts["transform_matrix"][row][column] = value
    return facts


BAD_CAMERAS = [
    None,
    [],
    *(with_matrix(0, 3, value) for value in (float("nan"), float("inf"), None, "1", True, 1e16)),
    *(with_matrix(1, 1, value) for value in (float("nan"), 5, 1e300, 10**400)),
    with_matrix(3, 3, 2),
    frame_keys(CAMERA) | {"transform_matrix": [[1, 0, 0]] * 4},
    frame_keys(CAMERA) | {"transform_matrix": [1, 2, 3, 4]},
    frame_keys(replace(CAMERA, pose=CAMERA.pose * [-1, 1, 1, 1])),  # a mirror
    *(frame_keys(CAMERA) | {key: 0} for key in ("fl_x", "fl_y", "w", "h")),
    *(frame_keys(CAMERA) | {"cx": value} for value in (float("nan"), 1e6, None)),
    *(frame_keys(CAMERA) | {"w": value} for value in (15, 48.0, 5000, True)),
    frame_keys(CAMERA) | {"w": 4096, "h": 4096},
]


def test_a_camera_that_is_none_is_refused_in_one_line():
    for camera in BAD_CAMERAS:
        with pytest.raises(UserError) as caught:
            read_request(json.dumps(asking(CAMERA) | {"camera": camera}))
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 160


@pytest.mark.parametrize(
    "change",
    [
        *({name: least - 0.1} for name, (least, _) in RANGES.items()),
        *({name: most + 0.1} for name, (_, most) in RANGES.items()),
        *({name: float("nan")} for name in RANGES),
        {"show": "secrets"},
        {"show": ["colour"]},
        {"kind": "x"},
        {"number": 1.5},
        {"number": -1},
        {"number": 2**60},
        {"draft": 1},
    ],
)
def test_a_value_out_of_range_is_refused_by_name(change):
    with pytest.raises(UserError, match=f"{next(iter(change))}: must|finite"):
        read_request(json.dumps(asking(CAMERA, **change)))


@pytest.mark.parametrize("text", ["", "{", "[]", "1", "null", "[" * 8000, "1" * 8000, "\x00"])
def test_what_is_no_object_is_refused(text):
    with pytest.raises(UserError, match="JSON"):
        read_request(text)


def test_a_frame_is_packed_with_the_length_of_its_facts():
    message = packed({"a": 1}, b"file")
    length = int.from_bytes(message[:4], "little")
    assert json.loads(message[4 : 4 + length]) == {"a": 1} and message[4 + length :] == b"file"
