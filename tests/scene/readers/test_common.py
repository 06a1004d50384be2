import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.refused import refusing
from support.same_scene import held_out, views
from support.transforms_scenes import escape, refused

from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import write_png
from pp_cl.scene.listing import scene_frames
from pp_cl.scene.load import load_scene
from pp_cl.scene.lookup import find_image, find_masks, folder_images, numbered
from pp_cl.scene.readers import common
from pp_cl.scene.readers.common import (
    fail_at,
    hold_out,
    read_json,
    read_npy,
    read_npz,
    read_numbers,
)
from tools.convert_scene import convert

FAIL = fail_at("file")
# {format: (folder of the images, folder of the masks or None if they are the images' alpha)}
FOLDERS = {
    "co3d": ("images", "masks"),
    "colmap": ("images", "masks"),
    "llff": ("images", "masks"),
    "nerfstudio": ("images", "masks"),
    "neus": ("image", "mask"),
    "nsvf": ("rgb", None),
}


@pytest.fixture
def made(tmp_path):
    """A function that writes a format and returns (the scene's folder, that of images, that of
    masks).
    """

    def make(name):
        splits = held_out(views(centred=name == "llff", alike=name in ("llff", "nsvf")))
        convert(splits, tmp_path / "scene", name)
        folder = tmp_path / "scene" / ("object/sequence" if name == "co3d" else ".")
        images, masks = FOLDERS[name]
        return folder, folder / images, masks and folder / masks

    return make


@pytest.mark.parametrize("name", FOLDERS)
def test_links_of_the_user_are_followed(made, name):
    folder, *places = made(name)
    before = load_scene(folder).splits["train"]
    escape(sorted(places[0].iterdir())[2])
    for place in filter(None, places):
        escape(place)
    for view, other in zip(before, load_scene(folder).splits["train"], strict=True):
        assert view.name == other.name
        np.testing.assert_array_equal(view.image, other.image)


def cut(file):
    file.write_bytes(file.read_bytes()[:-200])


HARM = {
    "gone": (Path.unlink, "no (image|mask)"),
    "cut": (cut, "a mask that cannot be used|an image that cannot be read"),
    "of another shape": (
        lambda file: write_png(file, np.zeros((4, 4))),
        "a mask that cannot be|an image of another shape|the scene's files describe",
    ),
}
# If the folder is the only list of images, a deleted one is not missed. Nor is a deleted mask: the
# hull of the other masks shows that (tests/scene/test_silhouette.py). NeuS and NSVF state no size
# for cameras.
HARMED = [
    (name, place, harm)
    for name in FOLDERS
    for place in ("image", "mask")
    for harm in HARM
    if (name, place) != ("nsvf", "mask")
    and (name, place, harm) != ("nsvf", "image", "gone")
    and not (place == "mask" and harm == "gone" and name in ("colmap", "llff", "neus"))
    and not (place == "image" and harm == "of another shape" and name in ("neus", "nsvf"))
]


@pytest.mark.parametrize("name, place, harm", HARMED)
def test_a_view_that_cannot_be_used_is_left_out_and_two_of_nine_are_too_many(
    made, name, place, harm
):
    folder, images, masks = made(name)
    where, (do, why) = images if place == "image" else masks, HARM[harm]
    before = {view.name: view.stored_camera for view in load_scene(folder).splits["train"]}
    do(sorted(where.iterdir())[2])
    with pytest.warns(UserWarning, match=f"train: 1 of 9 views left out: ({why})") as warned:
        scene = load_scene(folder)
    assert len(warned) == 1 and len(scene.notes) == 1
    names = [view.name for view in scene.splits["train"]]
    assert names == [name for name in before if name in names] and len(names) == 8
    for view in scene.splits["train"]:
        assert np.array_equal(view.stored_camera.pose, before[view.name].pose)
    do(sorted(where.iterdir())[4])
    refused(folder, folder.parent if folder.name == "sequence" else folder)


@pytest.mark.parametrize("name", ["colmap", "llff", "nerfstudio"])
def test_images_that_were_reduced(made, name):
    """People reduce images to save time, after the cameras were found. In other formats cameras
    state no size, or are for the images as they are.
    """
    folder, images, _ = made(name)
    before = scene_frames(folder)
    for level, file in enumerate(sorted(images.iterdir())):
        write_png(file, np.full((11, 15), level / 20))
    for got, full in zip(scene_frames(folder), before, strict=True):
        half = full.camera.downscaled(2)
        np.testing.assert_allclose(got.camera.packed((1, 2)), half.packed((1, 2)), atol=1e-5)
        assert (type(got.camera.width), type(got.camera.height)) == (int, int)


@pytest.mark.parametrize("name", [name for name, (_, masks) in FOLDERS.items() if masks])
def test_masks_of_another_size(made, name):
    folder, _, masks = made(name)
    file = sorted(masks.iterdir())[2]
    mask = Image.open(file)
    mask.resize((2 * mask.width, 2 * mask.height)).save(file)
    with pytest.warns(UserWarning, match="masks are resized to their images"):
        assert len(load_scene(folder).splits["train"]) == 9


@pytest.mark.parametrize("name", ["colmap", "llff", "neus"])
def test_no_folder_of_masks_at_all(made, name):
    folder, _, masks = made(name)
    shutil.rmtree(masks)
    for view in load_scene(folder).splits["train"]:
        assert (view.image[..., 3] == 255).all()


def test_every_eighth_is_held_out():
    assert hold_out(range(18), "test") == [0, 8, 16]
    assert sorted(hold_out(range(18), "test") + hold_out(range(18), "train")) == list(range(18))


@pytest.mark.parametrize(
    "given, there",
    [
        ("/home/ada/mug/images/a.png", "images/a.png"),
        (r"C:\Users\ada\mug\images\a.png", "images/a.png"),
        (r".\images\a.png", "images/a.png"),
        ("images/a.jpg", "images/a.png"),
        ("images/A.PNG", "images/a.png"),
        ("images/a.png.png", "images/a.png"),
        ("images/a", "images/a.png"),
        ("a.png", "images/a.png"),
        ("a.png", "a.png"),
        ("images/a.png", "a.png"),
        ("images/a.png", "input/a.png"),
        ("images/a.png", "images_4/a.png"),
        ("images/low/a.png", "images_2/low/a.png"),
        ("a.png", "dense/0/images/a.png"),
    ],
)
def test_which_image_a_name_means(tmp_path, given, there):
    for path in ("masks/a.png", "depth/a.png", there):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(b"")
    assert find_image(tmp_path, given, FAIL) == there
    (tmp_path / there).unlink()
    with pytest.raises(Unusable, match="no image at"):
        find_image(tmp_path, given, FAIL)


def test_alpha_goes_before_and_two_that_differ_in_case_are_none(tmp_path):
    for name in ("a.jpg", "a.png", "bC.jpg", "Bc.jpg"):
        (tmp_path / name).write_bytes(b"")
    assert find_image(tmp_path, "a", FAIL) == find_image(tmp_path, "./b/../a.png", FAIL) == "a.png"
    for name in ("b", "bc.jpg"):
        with pytest.raises(Unusable, match=f"no image at '{name}' in "):
            find_image(tmp_path, name, FAIL)


def test_places_in_a_list_of_which_some_are_gone():
    names = [f"images/f_{i:02d}.png" for i in (3, 4, 6, 7)]
    assert numbered(names, 4) == dict(enumerate(names))
    assert numbered(names, 5) == dict(zip((0, 1, 3, 4), names, strict=True))
    assert numbered(names, 6) is None, "the first or the last may be gone"
    assert numbered(["a.png", "b.png"], 3) is None


@pytest.mark.unix
def test_paths_as_windows_writes_them(tmp_path):
    """The path may also be the file's name, if a zip made on Windows was unpacked elsewhere."""
    (tmp_path / "images").mkdir()
    write_png(tmp_path / r"images\b.png", np.zeros((2, 2)))
    assert find_image(tmp_path, r"images\b.png", FAIL) == r"images\b.png"
    with pytest.raises(UserError, match="leaves the scene's folder"):
        find_image(tmp_path / "images", r"..\images\..\a.png", FAIL)


@pytest.mark.parametrize("given", ["../a.png", "b/../../a.png", "/etc/hostname", "a" * 999, "a\0b"])
def test_paths_that_cannot_be_used(tmp_path, given):
    (tmp_path / "scene").mkdir()
    write_png(tmp_path / "a.png", np.zeros((2, 2)))
    with pytest.raises(UserError, match="^file: "):
        find_image(tmp_path / "scene", given, FAIL)


def test_images_of_a_folder_are_sorted_and_nothing_else_is_one(tmp_path):
    (tmp_path / "images" / "sub.png").mkdir(parents=True)
    for name in ("b.png", "a.PNG", "c.txt", "._b.png"):
        (tmp_path / "images" / name).write_bytes(b"")
    assert folder_images(tmp_path, "images") == ["images/a.PNG", "images/b.png"]


@pytest.mark.parametrize("mask", ["a.jpg.png", "a.png", "a.jpeg", "a_mask.JPG", "mask_a.png"])
def test_a_mask_is_named_like_its_image(tmp_path, mask):
    images = ["images/sub/a.jpg", "images/b.jpg", "images/" + "x" * 251 + ".png"]
    assert find_masks(tmp_path, images) is None
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    with pytest.raises(UserError, match=r"masks/sub/a\.jpg\.png"):
        find_masks(tmp_path, images)
    (tmp_path / "masks" / "sub" / mask).write_bytes(b"")
    assert find_masks(tmp_path, images) == {images[0]: f"masks/sub/{mask}"}


def test_what_numpy_writes(tmp_path, rng):
    array = rng.normal(size=(4, 3))
    for index, stored in enumerate((array, np.asfortranarray(array), array.astype("<f4"))):
        np.save(tmp_path / f"{index}.npy", stored)
        np.testing.assert_array_equal(read_npy(tmp_path / f"{index}.npy"), stored)
    np.save(tmp_path / "whole.npy", np.array([[1, -2]], np.int16))
    assert read_npy(tmp_path / "whole.npy").tolist() == [[1, -2]]
    np.savez_compressed(tmp_path / "a.npz", cam_1=array, other=array)
    assert list(read_npz(tmp_path / "a.npz", "cam_")) == ["cam_1"]
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.write(tmp_path / "0.npy", "cam_1.npy")
    with refusing(tmp_path / "b.npz", "is compressed in a way"):
        read_npz(tmp_path / "b.npz", "cam_")


def test_json_of_at_most_so_many_bytes(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text('{"frames": [1, 2]}', encoding="utf-8-sig")
    assert read_json(tmp_path / "a.json") == {"frames": [1, 2]}
    monkeypatch.setattr(common, "MOST_JSON", 20)
    with refusing(tmp_path / "a.json"):
        read_json(tmp_path / "a.json")
    monkeypatch.setattr("pp_cl.files.untrusted.MOST_VALUES", 2)
    monkeypatch.setattr(common, "MOST_JSON", 21)
    with refusing(tmp_path / "a.json"):
        read_json(tmp_path / "a.json")


def test_lines_of_numbers(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1 2.5\r\n\r\n-3e2\r\n")  # as Windows writes it
    assert read_numbers(tmp_path / "a.txt") == [[1, 2.5], [-300]]


FLOATS = "{'descr': '<f8', 'fortran_order': False, 'shape': %s}"
HEADERS = {
    "open bracket": "{'descr': '<f8', 'fortran_order': False, 'shape': (3,",
    "negative": FLOATS % "(-1, 4)",
    "nothing times much": FLOATS % f"(0, {10**30})",
    "too many dimensions": FLOATS % f"({'1, ' * 70})",
    "pairs": "{'descr': ('<f8', (2,)), 'fortran_order': False, 'shape': (2,)}",
    "shape beyond all memory": FLOATS % f"({2**40}, {2**20})",
    "too early": FLOATS % "(17,)",
    "nested": "(" * 500,
}


@pytest.mark.parametrize("case", HEADERS)
def test_headers_that_lie(tmp_path, case):
    """The headers are of a .npy file with 16 numbers."""
    header = HEADERS[case].encode().ljust(1000) + b"\n"
    content = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header + bytes(128)
    (tmp_path / "a.npy").write_bytes(content)
    with refusing(tmp_path / "a.npy"):
        read_npy(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "cam.npy")
    with refusing(tmp_path / "a.npz"):
        read_npz(tmp_path / "a.npz", "cam")


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x01\0", b"\x93NUMPY\x02\0" + bytes(100)])
def test_what_is_no_array(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    for read in (read_npy, lambda file: read_npz(file, "cam")):
        with refusing(tmp_path / "a.npy"):
            read(tmp_path / "a.npy")


@pytest.mark.parametrize("array", [np.array([None]), np.array("K"), 1j * np.ones(3), [np.inf]])
def test_what_holds_no_finite_numbers(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with refusing(tmp_path / "a.npy"):
        read_npy(tmp_path / "a.npy")


def test_all_arrays_of_a_file_count(tmp_path, monkeypatch):
    monkeypatch.setattr(common, "MOST_ARRAYS", 128)
    np.savez(tmp_path / "a.npz", cam_1=np.zeros(16), other=np.zeros(9))
    assert len(read_npz(tmp_path / "a.npz", "cam_")) == 1
    np.savez(tmp_path / "b.npz", cam_1=np.zeros(9, "<f4"), cam_2=np.zeros(9, "<f4"))
    with refusing(tmp_path / "b.npz"):
        read_npz(tmp_path / "b.npz", "cam_")
