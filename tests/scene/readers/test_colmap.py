import shutil
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from support.same_scene import held_out, same, views
from support.transforms_scenes import left_out, refused

from pp_cl.files.image import write_png
from pp_cl.scene.lens import LensDistortion
from pp_cl.scene.listing import scene_frames
from pp_cl.scene.readers.colmap import read_model, read_split
from tools.capture_demo import align, cameras
from tools.scene_formats import colmap

SIZE = (30, 22)
# COLMAP 3.8's result for images by tools/capture_demo.py: six of the 64 images with their first 2D
# points, one without any, written in both forms by COLMAP's model_converter.
BY_COLMAP = Path(__file__).parent / "colmap_models"


@pytest.fixture(params=[True, False], ids=["binary", "text"])
def written(request, tmp_path):
    splits = held_out(views(size=SIZE))
    colmap.write(tmp_path, splits, request.param)
    return tmp_path, splits


@pytest.fixture
def text(tmp_path):
    colmap.write(tmp_path, held_out(views(size=SIZE)), binary=False)
    return tmp_path


@pytest.fixture
def binary(tmp_path):
    colmap.write(tmp_path, held_out(views(size=SIZE)))
    return tmp_path


@pytest.mark.parametrize("place", ["sparse", "sparse/0", "colmap/sparse/0", "dense/0/sparse", "."])
def test_a_model_is_found_in_the_usual_places(written, place):
    folder, splits = written
    (folder / place).mkdir(parents=True, exist_ok=True)
    for file in list((folder / "sparse" / "0").iterdir()):
        file.rename(folder / place / file.name)
    same(folder, splits)


def test_a_projection_by_hand(tmp_path):
    """x_cam = R(q) x + t; the centre of the first pixel is at 0.5, as COLMAP's documentation says.
    The rotation is a quarter turn about z: q = (cos 45, 0, 0, sin 45).
    """
    (tmp_path / "images" / "sub").mkdir(parents=True)
    write_png(tmp_path / "images" / "sub" / "a b.png", np.zeros((22, 30, 3)))
    half = np.sqrt(0.5)
    (tmp_path / "cameras.txt").write_text("# c\n7 OPENCV 30 22 40 41 14 12 .1 .01 .002 -.003\n")
    (tmp_path / "images.txt").write_text(f"1 {half} 0 0 {half} 1 2 5 7 sub/a b.png\n1 2 -1\n")
    [image_file] = read_split(tmp_path, "test", [])
    camera, d = image_file.camera, image_file.lens
    point = np.array([0.3, -0.2, 0.7])
    expected = np.array([0.2 + 1, 0.3 + 2, 0.7 + 5])  # (x, y) -> (-y, x), then t
    np.testing.assert_allclose(camera.pose[:, :3].T @ (point - camera.eye), expected, atol=1e-12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 41, 14, 12)
    assert (d.k1, d.k2, d.p1, d.p2, d.k3) == (0.1, 0.01, 0.002, -0.003, 0)
    assert image_file.name == "images/sub/a b.png" and image_file.mask is None


@pytest.mark.parametrize(
    "line, focal, lens",
    [
        ("SIMPLE_PINHOLE 30 22 40 15 11", (40, 40), LensDistortion()),
        ("PINHOLE 30 22 40 42 15 11", (40, 42), LensDistortion()),
        ("SIMPLE_RADIAL 30 22 40 15 11 .2", (40, 40), LensDistortion(0.2)),
        ("RADIAL 30 22 40 15 11 .2 -.1", (40, 40), LensDistortion(0.2, -0.1)),
        ("FISHEYE 30 22 40 42 15 11", (40, 42), LensDistortion(fisheye=True)),
        ("SIMPLE_RADIAL_FISHEYE 30 22 40 15 11 .2", (40, 40), LensDistortion(0.2, fisheye=True)),
        ("RADIAL_FISHEYE 30 22 40 15 11 .2 -.1", (40, 40), LensDistortion(0.2, -0.1, fisheye=True)),
        (
            "OPENCV_FISHEYE 30 22 40 42 15 11 .2 -.1 .3 -.4",
            (40, 42),
            LensDistortion(0.2, -0.1, k3=0.3, k4=-0.4, fisheye=True),
        ),
        (
            "FULL_OPENCV 30 22 40 42 15 11 1 2 3 4 5 6 7 8",
            (40, 42),
            LensDistortion(k1=1, k2=2, p1=3, p2=4, k3=5, k4=6, k5=7, k6=8),
        ),
    ],
)
def test_models(text, line, focal, lens):
    edit(text, "cameras.txt", lambda lines: [f"{i + 1} {line}" for i in range(11)])
    for image_file in read_split(text, "train", []):
        camera = image_file.camera
        assert (camera.fx, camera.fy) == focal and image_file.lens == lens
        assert (camera.cx, camera.cy) == (15, 11)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_a_model_that_colmap_wrote(tmp_path, form):
    shutil.copytree(BY_COLMAP / form, tmp_path / "sparse" / "0")
    (tmp_path / "images").mkdir()
    numbers = (0, 9, 20, 31, 42, 53)
    for i in numbers:
        write_png(tmp_path / "images" / f"{i:03d}.png", np.zeros((400, 400)))
    image_files = [
        image_file for split in ("test", "train") for image_file in read_split(tmp_path, split, [])
    ]
    assert [image_file.name for image_file in image_files] == [
        f"images/{i:03d}.png" for i in numbers
    ]
    for image_file in image_files:
        camera, k1 = image_file.camera, -0.0025245658661648311
        assert camera.fx == camera.fy == 323.03151019681525 and (camera.cx, camera.cy) == (200, 200)
        assert image_file.lens == LensDistortion(k1=k1)
    true = cameras(400)
    alignment = align([image_file.camera for image_file in image_files], [true[i] for i in numbers])
    assert alignment.position < 0.02 and alignment.degrees < 0.2


def test_binary_goes_before_text(binary):
    for name in ("cameras", "images"):
        (binary / "sparse" / "0" / f"{name}.txt").write_text("no model")
    assert len(read_split(binary, "train", [])) == 9


def test_text_as_other_programs_write_it(text):
    before = read_split(text, "train", [])
    for name in ("cameras.txt", "images.txt"):
        file = text / "sparse" / "0" / name
        lines = file.read_text().replace(".png\n\n", ".png\n1.5 2 -1 3 4.5 17\n\n# next\n\n")
        file.write_bytes(b"\xef\xbb\xbf" + lines.replace("\n", "\r\n").encode())
    for got, expected in zip(read_split(text, "train", []), before, strict=True):
        assert got.name == expected.name and np.array_equal(got.camera.pose, expected.camera.pose)
    for file in (text / "sparse/0").glob("*.txt"):
        file.write_text(file.read_text("utf-8-sig"), encoding="utf-16")
    assert [view.name for view in read_split(text, "train", [])] == [view.name for view in before]


def test_2d_points_take_no_memory(tmp_path):
    count = 2**24
    lens = struct.pack("<QIiQQ3d", 1, 1, 0, *SIZE, 40, 15, 11)
    image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 3, 1) + b"a.png\0"
    (tmp_path / "cameras.bin").write_bytes(lens)
    with (tmp_path / "images.bin").open("wb") as file:
        file.write(image + struct.pack("<Q", count))
        file.truncate(file.tell() + 24 * count)  # a hole, which takes no space on the disk
    tracemalloc.start()
    _, [image] = read_model(tmp_path)
    assert image.name == "a.png" and tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def edit(folder, name, change):
    file = folder / "sparse" / "0" / name
    lines = [line for line in file.read_text().split("\n") if not line.startswith("#")]
    file.write_text("\n".join(change(lines)))


def second(change):
    def changed(lines):
        at = 2 if lines[1] == "" else 1
        lines[at] = " ".join(change(lines[at].split()))
        return lines

    return changed


def replaced(place, value):
    return second(lambda words: [*words[:place], value, *words[place + 1 :]])


BAD_TEXT = {
    "model": ("cameras.txt", replaced(1, "PINHOL"), "line 2"),
    "a focal length that is no number": ("cameras.txt", replaced(4, "f"), "line 2"),
    "a parameter is missing": ("cameras.txt", second(lambda w: w[:-1]), "line 2"),
    "huge principal point": ("cameras.txt", replaced(6, "1e300"), "line 2"),
    "camera twice": ("cameras.txt", replaced(0, "1"), "camera 1"),
    "other shape": ("cameras.txt", replaced(2, "44"), "000001.png"),
    "no size": ("cameras.txt", replaced(2, f"{2**40}"), "line 2"),
    "quaternion": ("images.txt", replaced(1, "3"), "000001.png"),
    "huge place": ("images.txt", replaced(5, "1e300"), "000001.png"),
    "a place that is NaN": ("images.txt", replaced(5, "nan"), "000001.png"),
    "no lines of 2D points": ("images.txt", lambda lines: lines[::2], "line 2"),
    "broken 2D points": ("images.txt", lambda lines: [lines[0], "1 2", *lines[2:]], "line 2"),
    "escape sequence in a name": ("images.txt", replaced(9, "\x1b[2J.png"), "line 3"),
    "image twice by two paths": ("images.txt", replaced(9, "./000000.png"), "./000000.png"),
    "unknown camera": ("images.txt", replaced(8, "77"), "camera 77"),
    "outside": ("images.txt", replaced(9, "../../x.png"), "leaves the scene's folder"),
    "no images": ("images.txt", lambda lines: [], "images.txt"),
}


# {case: split whose bad image is left out, while the others train}
LEFT_OUT = {
    "a parameter is missing": "train",
    "huge principal point": "train",
    "quaternion": "train",
    "huge place": "train",
    "a place that is NaN": "train",
    "other shape": "train",
    "no size": "train",
    "unknown camera": "train",
    "outside": "test",
}


@pytest.mark.parametrize("case", BAD_TEXT)
def test_bad_text(text, case):
    name, change, word = BAD_TEXT[case]
    write_png(text.parent / "x.png", np.zeros((22, 30, 3)))
    edit(text, name, change)
    if case in LEFT_OUT:
        left_out(text, text / "sparse" / "0", word, split=LEFT_OUT[case])
    else:
        refused(text, text / "sparse" / "0", word, splits=("train", "test"))


def test_of_several_models_the_largest_is_read(written):
    """COLMAP may leave sparse/0 with two images and the rest in sparse/1."""
    folder, _ = written
    (folder / "sparse/0").rename(folder / "sparse/3")
    for kind in ("cameras", "images"):
        for file in (folder / "sparse/3").glob(f"{kind}.*"):
            (folder / "sparse/0").mkdir(exist_ok=True)
            content = file.read_bytes()
            if file.name == "images.txt":
                content = b"\n".join(content.split(b"\n")[:8]) + b"\n"
            elif file.name == "images.bin":
                content = (1).to_bytes(8, "little") + content[8 : 8 + 64 + len("000000.png") + 9]
            (folder / "sparse/0" / file.name).write_bytes(content)
    with pytest.warns(UserWarning, match="of 2 models, the largest with images next to it is read"):
        assert len(scene_frames(folder)) == 9
    for file in (*(folder / "images").iterdir(), *(folder / "sparse/3").iterdir()):
        file.rename(folder / file.name)  # RealityScan writes images and model to one folder
    shutil.rmtree(folder / "sparse")
    assert [view.name for view in scene_frames(folder)][:2] == ["000001.png", "000002.png"]


@pytest.mark.parametrize("ending", ["", ".png"])
def test_lists_beside_a_model_are_its_splits(text, ending):
    """As 3DGS reads test.txt. What only a list of training leaves is for test."""
    names = sorted(file.name for file in (text / "images").iterdir())
    model = text / "sparse/0"

    def split(name):
        with pytest.warns(UserWarning, match=r"splits are as t\w+\.txt( and train\.txt)? lists"):
            return [Path(image.name).name for image in read_split(text, name, [])]

    def write(name, of):
        (model / name).write_text("\n".join(Path(n).stem + ending for n in of) + "\n\n")

    write("test.txt", names[-3:])
    assert (split("test"), split("train")) == (names[-3:], names[:-3])
    write("train.txt", names[2:])
    assert (split("test"), split("train")) == (names[-3:], names[2:-3])
    (model / "test.txt").unlink()
    assert (split("test"), split("train")) == (names[:2], names[2:])
    write("train.txt", ["other"])
    refused(text, model / "train.txt", "names no image", splits=("train", "test"))


@pytest.mark.parametrize("word", ["-nan(ind)", "1.#QNAN", "-1.#INF", "nan"])
def test_a_number_that_windows_writes_loses_its_views_alone(text, word):
    file = text / "sparse/0/images.txt"
    lines = file.read_text().splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if line.rstrip().endswith("000003.png"))
    words = lines[at].split(" ")
    words[5] = word
    lines[at] = " ".join(words)
    file.write_text("".join(lines))
    left_out(text, "unit quaternion", split="train")


def test_models_of_later_versions_are_named(binary):
    """SIMPLE_DIVISION, number 12, has as many parameters as PINHOLE. Only the view that has it is
    lost.
    """
    file = binary / "sparse" / "0" / "cameras.bin"
    data = file.read_bytes()
    file.write_bytes(data[:12] + struct.pack("<i", 12) + data[16:])
    command = f"colmap image_undistorter --image_path {binary / 'images'}"
    left_out(binary, "SIMPLE_DIVISION", command, split="test")


def test_panoramas_are_no_unknown_lens(text):
    edit(
        text,
        "cameras.txt",
        lambda lines: [f"{i + 1} EQUIRECTANGULAR 30 22 30 22" for i in range(11)],
    )
    refused(text, "EQUIRECTANGULAR is panoramic")


def test_more_cameras_than_a_model_has(text, monkeypatch):
    monkeypatch.setattr("pp_cl.scene.readers.colmap.MOST_RECORDS", 10)
    cameras = [f"{i + 1} PINHOLE 30 22 20 20 15 11" for i in range(11)]
    edit(text, "cameras.txt", lambda lines: cameras)
    refused(text, "cameras.txt: holds more than 10 records")


def test_more_records_or_letters_than_a_model_has(written, monkeypatch):
    folder, _ = written
    monkeypatch.setattr("pp_cl.scene.readers.colmap.MOST_RECORDS", 10)
    refused(folder, "more than 10 records")
    if (folder / "sparse/0/images.txt").exists():
        monkeypatch.setattr("pp_cl.scene.readers.colmap.MOST_LINE", 40)
        refused(folder, "has 40 characters or more")


BAD_BYTES = {
    "cut in a camera": ("cameras.bin", lambda b: b[:60]),
    "cut in a name": ("images.bin", lambda b: b[:76]),
    "a count beyond all memory": ("images.bin", lambda b: struct.pack("<Q", 2**60) + b[8:]),
    "2D points beyond the end": ("images.bin", lambda b: b[:-8] + struct.pack("<Q", 9)),
    "more than the count": ("cameras.bin", lambda b: b + b"x"),
    "model number": ("cameras.bin", lambda b: b[:12] + struct.pack("<i", 99) + b[16:]),
    "no name": ("images.bin", lambda b: b[:72] + b[82:]),
}


@pytest.mark.parametrize("case", BAD_BYTES)
def test_bad_bytes(binary, case):
    name, change = BAD_BYTES[case]
    file = binary / "sparse" / "0" / name
    file.write_bytes(change(file.read_bytes()))
    refused(binary, file)


def test_a_name_in_no_code_page_costs_its_view(binary):
    file = binary / "sparse/0/images.bin"
    file.write_bytes(file.read_bytes().replace(b"000001.png", b"\xff00001.png"))
    left_out(binary, file.parent, "give the images ASCII names")
