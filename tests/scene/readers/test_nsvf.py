import unicodedata

import pytest
from support.same_scene import same, views
from support.transforms_scenes import refused

from pp_cl.scene.readers.nsvf import read_split, splits
from tools.scene_formats import nsvf


@pytest.fixture
def scene(tmp_path):
    many = views(alike=True)
    nsvf.write(tmp_path, {"train": many[:6], "val": many[6:8], "test": many[8:]})
    return tmp_path


def test_splits_are_those_of_the_names(scene):
    assert splits(scene) == ["test", "train", "val"]
    (scene / "rgb" / "9_other.png").write_bytes(b"")
    assert [len(read_split(scene, split, [])) for split in splits(scene)] == [3, 6, 2]


def test_where_there_is_no_2_test_is_1(tmp_path):
    """NSVF's Tanks and Temples and BlendedMVS are numbered like this."""
    many = views(alike=True)
    nsvf.write(tmp_path, {"train": many[:6], "test": many[6:]})
    for folder in ("rgb", "pose"):
        for file in (tmp_path / folder).glob("2_*"):
            file.rename(file.with_name(f"1_{file.name[2:]}"))
    assert splits(tmp_path) == ["test", "train"]
    same(tmp_path, {"train": many[:6], "test": many[6:]})


@pytest.mark.parametrize(
    "text, expected",
    [
        ("40 0 14 0\n0 41 12 0\n0 0 1 0\n0 0 0 1\n", (40, 41, 14, 12)),
        ("40 0 14\n0 41 12\n0 0 1\n", (40, 41, 14, 12)),
        ("40 14 12 0.\n0. 0. 0.\n0.\n1.\n22 30\n", (40, 40, 14, 12)),
        ("40 14 12 0.\n0. 0. 0.\n0.\n1.\n44 60\n", (20, 20, 7, 6)),
        ("40 14 12\n", (40, 40, 14, 12)),
    ],
    ids=["4x4", "3x3", "synthetic", "for another size", "one line"],
)
def test_intrinsics(scene, text, expected):
    (scene / "intrinsics.txt").write_text(text)
    camera = read_split(scene, "train", [])[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == expected


def test_poses_in_another_form_of_the_names(scene):
    """An accent may be part of its letter, or a character of its own."""
    for folder, form in (("rgb", "NFC"), ("pose", "NFD")):
        for file in (scene / folder).iterdir():
            file.rename(file.with_stem(unicodedata.normalize(form, f"{file.stem}_é")))
    assert len(read_split(scene, "train", left_out := [])) == 6 and not left_out


def test_near_and_far(scene):
    (scene / "near_and_far.txt").write_text("1.5 6\n")
    assert read_split(scene, "test", [])[0].depth_range == (1.5, 6.0)


POSE = "pose/0_train_000002.txt"
BAD = {
    "pose of words": (POSE, "a b c d\n"),
    "a long file": (POSE, "1 0 0 0\n" * 2**17 + "1"),
    "no intrinsics": ("intrinsics.txt", ""),
    "focal length 0": ("intrinsics.txt", "0 14 12 0\n"),
    "skew": ("intrinsics.txt", "40 2 14\n0 41 12\n0 0 1\n"),
    "height 0": ("intrinsics.txt", "40 14 12 0.\n0. 0. 0.\n0.\n1.\n0 30\n"),
    "another shape": ("intrinsics.txt", "40 14 12 0.\n30 22\n"),
    "far before near": ("near_and_far.txt", "3 2\n"),
    "infinite far": ("near_and_far.txt", "1 inf\n"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files(scene, case):
    name, content = BAD[case]
    (scene / name).write_text(content, errors="surrogateescape")
    refused(scene, scene / name)


def test_a_pose_is_missing_and_no_image_of_any_split(scene):
    (scene / POSE).unlink()
    refused(scene, scene / POSE, "no such file")
    for file in (scene / "rgb").iterdir():
        file.unlink()
    refused(scene, scene / "rgb", "no images")
    (scene / "rgb" / "000.png").write_bytes(b"")
    refused(scene, scene / "rgb", "0_ (train)")
