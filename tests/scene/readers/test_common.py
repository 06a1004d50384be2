"""What readers share: images inside the scene's folder, masks by name, splits, arrays of other
programs, all read without trust.
"""

import zipfile

import numpy as np
import pytest
from support.same_scene import held_out, views
from support.transforms_scenes import escape, refused

from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers import common
from pp_cl.scene.readers.common import (
    fail_at,
    find_image,
    find_mask,
    folder_images,
    hold_out,
    read_npy,
    read_npz,
    read_numbers,
)
from tools.convert_scene import convert

FAIL = fail_at("file")
# of each format: the folders of its images and of its masks, None where they are the images' alpha
FOLDERS = {
    "co3d": ("images", "masks"),
    "colmap": ("images", "masks"),
    "llff": ("images", "masks"),
    "nerfstudio": ("images", "masks"),
    "neus": ("image", "mask"),
    "nsvf": ("rgb", None),
}


@pytest.fixture(params=FOLDERS)
def scene(request, tmp_path):
    """(folder of a scene, its folder of images, its folder of masks) in each format."""
    name = request.param
    given = held_out(views(centred=name == "llff", alike=name in ("llff", "nsvf")))
    convert(given, tmp_path / "scene", name)
    folder = tmp_path / "scene" / ("object/sequence" if name == "co3d" else ".")
    images, masks = FOLDERS[name]
    return folder, folder / images, masks and folder / masks


def test_an_unknown_split_is_told_with_those_there_are(scene):
    refused(scene[0], "no split eval", "test, train", splits=("eval",))


def test_links_that_leave_the_folder(scene):
    folder, *places = scene
    for place in filter(None, places):
        file = sorted(place.iterdir())[2]
        kept = file.read_bytes()
        escape(file)
        refused(folder, "leaves the scene's folder")
        file.unlink()
        file.write_bytes(kept)


def test_a_mask_that_is_missing_and_no_masks_at_all(scene):
    """A folder of masks must have them all; without one the images' own alpha counts."""
    folder, _, masks = scene
    if masks is None:
        return
    file = sorted(masks.iterdir())[3]
    file.unlink()
    refused(folder, masks.name)
    for file in masks.iterdir():
        file.unlink()
    masks.rmdir()
    if folder.name != "sequence" and not (folder / "transforms.json").exists():
        for view in load_scene(folder).splits["train"]:
            assert (view.image[..., 3] == 255).all()


def test_a_mask_of_another_size(scene):
    folder, _, masks = scene
    if masks:
        file = sorted(masks.iterdir())[3]
        write_png(file, np.zeros((4, 4)))
        refused(folder, file, "4x4")


# --------------------------------------------------------------------------------------------------


def test_every_eighth_is_held_out():
    assert hold_out(range(18), "test") == [0, 8, 16]
    assert sorted(hold_out(range(18), "test") + hold_out(range(18), "train")) == list(range(18))


def test_the_first_ending_that_exists(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((2, 2)))
    assert find_image(tmp_path, "a", FAIL, ("", ".jpg", ".png")) == "a.png"
    assert find_image(tmp_path, "./b/../a.png", FAIL) == "a.png"
    with pytest.raises(UserError, match="'a', with or without the ending"):
        find_image(tmp_path, "a", FAIL, ("", ".jpg"))


@pytest.mark.unix
def test_paths_as_windows_writes_them(tmp_path):
    """Also as the name of a file, where a zip of Windows was unpacked elsewhere."""
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "a.png", np.zeros((2, 2)))
    assert find_image(tmp_path, r".\images\a.png", FAIL) == "images/a.png"
    write_png(tmp_path / r"images\b.png", np.zeros((2, 2)))
    assert find_image(tmp_path, r"images\b.png", FAIL) == r"images\b.png"
    with pytest.raises(UserError, match="leaves the scene's folder"):
        find_image(tmp_path / "images", r"..\images\..\a.png", FAIL)


@pytest.mark.parametrize("given", ["../a.png", "/etc/hostname", "link.png", "a" * 999, "a\0b"])
def test_paths_that_cannot_be_used(tmp_path, given):
    (tmp_path / "scene").mkdir()
    write_png(tmp_path / "a.png", np.zeros((2, 2)))
    (tmp_path / "scene" / "link.png").symlink_to(tmp_path / "a.png")
    with pytest.raises(UserError, match="^file: ") as caught:
        find_image(tmp_path / "scene", given, FAIL)
    assert "\n" not in str(caught.value)


def test_images_of_a_folder_are_sorted_and_nothing_else_is_one(tmp_path):
    (tmp_path / "images" / "sub.png").mkdir(parents=True)
    for name in ("b.png", "a.PNG", "c.txt", "._b.png"):
        (tmp_path / "images" / name).write_bytes(b"")
    assert folder_images(tmp_path, "images") == ["images/a.PNG", "images/b.png"]


@pytest.mark.parametrize("mask", ["a.jpg.png", "a.png", "a.jpeg", "a_mask.JPG", "mask_a.png"])
def test_a_mask_is_named_like_its_image(tmp_path, mask):
    assert find_mask(tmp_path, "masks", "sub/a.jpg", FAIL) is None
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    with pytest.raises(UserError, match=r"masks/sub/a\.jpg\.png"):
        find_mask(tmp_path, "masks", "sub/a.jpg", FAIL)
    with pytest.raises(UserError, match="masks"):
        find_mask(tmp_path, "masks", "x" * 251 + ".png", FAIL)
    (tmp_path / "masks" / "sub" / mask).write_bytes(b"")
    assert find_mask(tmp_path, "masks", "sub/a.jpg", FAIL) == f"masks/sub/{mask}"


# --------------------------------------------------------------------------------------------------


def test_what_numpy_writes(tmp_path, rng):
    array = rng.normal(size=(4, 3))
    for index, stored in enumerate((array, np.asfortranarray(array), array.astype("<f4"))):
        np.save(tmp_path / f"{index}.npy", stored)
        np.testing.assert_array_equal(read_npy(tmp_path / f"{index}.npy"), stored)
    np.save(tmp_path / "whole.npy", np.array([[1, -2]], np.int16))
    assert read_npy(tmp_path / "whole.npy").tolist() == [[1, -2]]
    np.savez_compressed(tmp_path / "a.npz", cam_1=array, other=array)
    assert list(read_npz(tmp_path / "a.npz", "cam_")) == ["cam_1"]


def test_lines_of_numbers(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1 2.5\r\n\r\n-3e2\r\n")  # as Windows does
    assert read_numbers(tmp_path / "a.txt") == [[1, 2.5], [-300]]


FLOATS = "{'descr': '<f8', 'fortran_order': False, 'shape': %s}"
HEADERS = {
    "open bracket": "{'descr': '<f8', 'fortran_order': False, 'shape': (3,",
    "negative": FLOATS % "(-1, 4)",
    "twice negative": FLOATS % "(-1, -4)",
    "nothing times much": FLOATS % f"(0, {10**30})",
    "too many dimensions": FLOATS % f"({'1, ' * 70})",
    "pairs": "{'descr': ('<f8', (2,)), 'fortran_order': False, 'shape': (2,)}",
    "bytes beyond memory": FLOATS.replace("<f8", "<u1") % f"({2**26},)",
    "shape beyond all memory": FLOATS % f"({2**40}, {2**20})",
    "too early": FLOATS % "(17,)",
    "nested": "(" * 500,
}


def unreadable(read, *given):
    with pytest.raises(UserError) as caught:
        read(*given)
    assert str(given[0]) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("case", HEADERS)
def test_headers_that_lie(tmp_path, case):
    """Of a .npy file with 16 numbers."""
    header = HEADERS[case].encode().ljust(1000) + b"\n"
    content = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header + bytes(128)
    (tmp_path / "a.npy").write_bytes(content)
    unreadable(read_npy, tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "cam.npy")
    unreadable(read_npz, tmp_path / "a.npz", "cam")


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x01\0", b"\x93NUMPY\x09\0" + bytes(100)])
def test_what_is_no_array(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    unreadable(read_npy, tmp_path / "a.npy")
    unreadable(read_npz, tmp_path / "a.npy", "cam")


@pytest.mark.parametrize(
    "array", [np.array([None]), np.array("K"), 1j * np.ones(3), np.array([np.nan]), [np.inf], 1e31]
)
def test_what_holds_no_finite_numbers(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    unreadable(read_npy, tmp_path / "a.npy")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_compressed_file_with_a_changed_byte(tmp_path, rng, method):
    """Wherever it is, one line says so, unless the byte does not matter."""
    np.save(tmp_path / "a.npy", rng.normal(size=(3, 4)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.write(tmp_path / "a.npy", "cam.npy")
    data, refusals = (tmp_path / "a.npz").read_bytes(), 0
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 0xFF
        (tmp_path / "a.npz").write_bytes(changed)
        try:
            read_npz(tmp_path / "a.npz", "cam")
        except UserError as error:
            refusals += 1
            assert "\n" not in str(error)
    assert refusals > len(data) // 2


def test_all_arrays_of_a_file_count(tmp_path, monkeypatch):
    """Small as each may be: 16 numbers fit, two arrays of 9 do not."""
    monkeypatch.setattr(common, "MOST_ARRAYS", 128)
    np.savez(tmp_path / "a.npz", cam_1=np.zeros(16), other=np.zeros(9))
    assert len(read_npz(tmp_path / "a.npz", "cam_")) == 1
    np.savez(tmp_path / "b.npz", cam_1=np.zeros(9, "<f4"), cam_2=np.zeros(9, "<f4"))
    unreadable(read_npz, tmp_path / "b.npz", "cam_")
