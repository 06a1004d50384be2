"""The reader of COLMAP's models: text and binary, its conventions, and every kind of bad input."""

import struct

import numpy as np
import pytest
from support.same_scene import held_out, same, views
from support.transforms_scenes import refused

from pp_cl.files.image import write_png
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers.colmap import read_split
from tools.scene_formats import colmap

SIZE = (30, 22)


@pytest.fixture(params=[True, False], ids=["binary", "text"])
def written(request, tmp_path):
    """(folder, splits) of a scene."""
    splits = held_out(views(size=SIZE))
    colmap.write(tmp_path, splits, request.param)
    return tmp_path, splits


@pytest.fixture
def text(tmp_path):
    """A folder with a text model."""
    colmap.write(tmp_path, held_out(views(size=SIZE)), binary=False)
    return tmp_path


@pytest.fixture
def binary(tmp_path):
    """The same with a binary model."""
    colmap.write(tmp_path, held_out(views(size=SIZE)))
    return tmp_path


def test_what_was_written_is_read(written):
    same(*written)


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", "."])
def test_a_model_is_found_in_the_usual_places(written, place):
    folder, splits = written
    (folder / place).mkdir(parents=True, exist_ok=True)
    for file in list((folder / "sparse" / "0").iterdir()):
        file.rename(folder / place / file.name)
    same(folder, splits)


def test_a_projection_by_hand(tmp_path):
    """x_cam = R(q) x + t, pixels with the centre of the first at 0.5, as COLMAP's documentation
    has it. A quarter turn about z: q = (cos 45, 0, 0, sin 45).
    """
    (tmp_path / "images" / "sub").mkdir(parents=True)
    write_png(tmp_path / "images" / "sub" / "a b.png", np.zeros((22, 30, 3)))
    half = np.sqrt(0.5)
    (tmp_path / "cameras.txt").write_text("# c\n7 OPENCV 30 22 40 41 14 12 .1 .01 .002 -.003\n")
    (tmp_path / "images.txt").write_text(f"1 {half} 0 0 {half} 1 2 5 7 sub/a b.png\n1 2 -1\n")
    [photograph] = read_split(tmp_path, "test")
    camera, d = photograph.camera, photograph.distortion
    point = np.array([0.3, -0.2, 0.7])
    expected = np.array([0.2 + 1, 0.3 + 2, 0.7 + 5])  # (x, y) -> (-y, x), then t
    np.testing.assert_allclose(camera.pose[:, :3].T @ (point - camera.eye), expected, atol=1e-12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 41, 14, 12)
    assert (d.k1, d.k2, d.p1, d.p2, d.k3) == (0.1, 0.01, 0.002, -0.003, 0)
    assert photograph.name == "images/sub/a b.png" and photograph.mask is None


@pytest.mark.parametrize(
    "line, focal, k",
    [
        ("SIMPLE_PINHOLE 30 22 40 15 11", (40, 40), (0, 0)),
        ("PINHOLE 30 22 40 42 15 11", (40, 42), (0, 0)),
        ("SIMPLE_RADIAL 30 22 40 15 11 .2", (40, 40), (0.2, 0)),
        ("RADIAL 30 22 40 15 11 .2 -.1", (40, 40), (0.2, -0.1)),
    ],
)
def test_models(text, line, focal, k):
    edit(text, "cameras.txt", lambda lines: [f"{i + 1} {line}" for i in range(11)])
    for photograph in read_split(text, "train"):
        camera, d = photograph.camera, photograph.distortion
        assert (camera.fx, camera.fy) == focal and (d.k1, d.k2) == k
        assert (camera.cx, camera.cy) == (15, 11)


def test_without_masks_the_images_own_alpha_counts(written):
    folder, _ = written
    for file in (folder / "masks").iterdir():
        file.unlink()
    (folder / "masks").rmdir()
    for view in load_scene(folder).splits["train"]:
        assert (view.image[..., 3] == 255).all()


def test_masks_with_the_ending_replaced(written):
    folder, splits = written
    for file in list((folder / "masks").iterdir()):
        file.rename(file.with_name(file.name.removesuffix(".png")))
    same(folder, splits)


# --------------------------------------------------------------------------------------------------


def edit(folder, name, change):
    """Change the lines of a text file of the model that are no comments."""
    file = folder / "sparse" / "0" / name
    lines = [line for line in file.read_text().split("\n") if not line.startswith("#")]
    file.write_text("\n".join(change(lines)))


def second(change):
    """Changes the second image's, or camera's, words."""

    def changed(lines):
        at = 2 if lines[1] == "" else 1
        lines[at] = " ".join(change(lines[at].split()))
        return lines

    return changed


def replaced(place, value):
    return second(lambda words: [*words[:place], value, *words[place + 1 :]])


BAD_TEXT = {
    "model": ("cameras.txt", replaced(1, "PINHOL"), "line 2", "PINHOL"),
    "fisheye": ("cameras.txt", replaced(1, "FOV"), "FOV has 5"),
    "width": ("cameras.txt", replaced(2, "0"), "line 2", "0x22"),
    "a focal length that is no number": ("cameras.txt", replaced(4, "f"), "line 2", "PARAMS"),
    "NaN": ("cameras.txt", replaced(4, "nan"), "finite"),
    "focal length 0": ("cameras.txt", replaced(4, "0"), "focal length 0"),
    "a parameter is missing": ("cameras.txt", second(lambda w: w[:-1]), "PINHOLE has 4"),
    "quaternion": ("images.txt", replaced(1, "3"), "000001.png", "unit quaternion"),
    "infinite place": ("images.txt", replaced(5, "inf"), "unit quaternion and place"),
    "short line": ("images.txt", second(lambda w: w[:6]), "line 3", "IMAGE_ID"),
    "unknown camera": ("images.txt", replaced(8, "77"), "77 is not in cameras.txt"),
    "image twice": ("images.txt", replaced(9, "000000.png"), "000000.png", "twice"),
    "missing image": ("images.txt", replaced(9, "none.png"), "none.png", "no image"),
    "outside": ("images.txt", replaced(9, "zz/../../../x.png"), "leaves the scene's folder"),
    "no images": ("images.txt", lambda lines: [], "holds no images"),
    "other size": ("cameras.txt", replaced(2, "31"), "000001.png", "31x22"),
}


@pytest.mark.parametrize("case", BAD_TEXT)
def test_bad_text(text, case):
    name, change, *words = BAD_TEXT[case]
    write_png(text.parent / "x.png", np.zeros((22, 30, 3)))
    edit(text, name, change)
    refused(text, text / "sparse" / "0", *words)


def test_other_models_are_named_with_the_command_that_converts_them(text):
    edit(text, "cameras.txt", replaced(1, "OPENCV_FISHEYE"))
    edit(text, "cameras.txt", second(lambda w: [*w, "0", "0", "0", "0"]))
    refused(text, "OPENCV_FISHEYE", "colmap image_undistorter", f"--image_path {text / 'images'}")


BAD_BYTES = {
    "cut in a camera": ("cameras.bin", lambda b: b[:60], "byte 60"),
    "cut in a name": ("images.bin", lambda b: b[:76], "does not end"),
    "a count beyond all memory": ("images.bin", lambda b: struct.pack("<Q", 2**60) + b[8:], "ends"),
    "2D points beyond the end": (
        "images.bin",
        lambda b: b[:83] + struct.pack("<Q", 2**60) + b[91:],
        "ends",
    ),
    "more than the count": ("cameras.bin", lambda b: b + b"x", "goes on"),
    "model number": ("cameras.bin", lambda b: b[:12] + struct.pack("<i", 99) + b[16:], "99"),
    "name": ("images.bin", lambda b: b[:72] + b"\xff" + b[73:], "UTF-8"),
    "size": ("cameras.bin", lambda b: b[:16] + struct.pack("<Q", 2**40) + b[24:], "no size"),
    "NaN": ("images.bin", lambda b: b[:12] + struct.pack("<d", np.nan) + b[20:], "quaternion"),
    "empty": ("cameras.bin", lambda b: b"", "ends at byte 0"),
}


@pytest.mark.parametrize("case", BAD_BYTES)
def test_bad_bytes(binary, case):
    name, change, *words = BAD_BYTES[case]
    file = binary / "sparse" / "0" / name
    file.write_bytes(change(file.read_bytes()))
    refused(binary, file, *words)


def test_a_missing_mask(written):
    folder, _ = written
    (folder / "masks" / "000003.png.png").unlink()
    refused(folder, "000003.png", "no mask masks/000003.png.png")


def test_a_mask_of_another_size(written):
    folder, _ = written
    write_png(folder / "masks" / "000003.png.png", np.zeros((4, 4)))
    refused(folder, "masks/000003.png.png", "4x4")


def test_an_unknown_split(written):
    refused(written[0], "no split val", "test, train", splits=("val",))
