import gzip
import json

import numpy as np
import pytest
from support.same_scene import held_out, views
from support.transforms_scenes import left_out, refused

from pp_cl.files.image import write_png
from pp_cl.scene.readers.co3d import read_split
from tools.scene_formats import co3d

ANNOTATIONS = "frame_annotations.jgz"


@pytest.fixture
def sequence(tmp_path):
    co3d.write(tmp_path, held_out(views()))
    return tmp_path / "object" / "sequence"


def annotations(folder):
    with gzip.open(folder.parent / ANNOTATIONS, "rt") as file:
        return json.load(file)


def annotate(folder, data):
    with gzip.open(folder.parent / ANNOTATIONS, "wt") as file:
        json.dump(data, file)


def edit(folder, change):
    data = annotations(folder)
    change(data[3])
    annotate(folder, data)


@pytest.mark.parametrize("size", [(40, 24), (24, 40), (33, 33)])
@pytest.mark.parametrize("kind", ["ndc_isotropic", "ndc_norm_image_bounds", None])
def test_projection_follows_pytorch3d(tmp_path, rng, size, kind):
    """x_camera = x_world R + T, with x to the left and y up; NDC are f x / z + p. x_ndc of 1 is the
    left border of a square image, or for ndc_isotropic if x is the shorter side.
    """
    folder = tmp_path / "apple" / "1_2_3"
    (folder / "images").mkdir(parents=True)
    write_png(folder / "images" / "a.png", np.zeros((size[1], size[0], 3)))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    place, focal, centre = np.array([0.1, -0.2, 5.0]), np.array([2.1, 2.3]), np.array([0.05, -0.1])
    viewpoint = {
        "R": rotation.tolist(),
        "T": place.tolist(),
        "focal_length": focal.tolist(),
        "principal_point": centre.tolist(),
        "intrinsics_format": kind,
    }
    image = {"path": "apple/1_2_3/images/a.png", "size": [size[1], size[0]]}
    frame = {"sequence_name": "1_2_3", "frame_number": 4, "image": image, "viewpoint": viewpoint}
    annotate(folder, [frame])
    [image_file] = read_split(folder, "test", [])
    camera = image_file.camera
    for point in rng.normal(size=(20, 3)):
        x, y, z = point @ rotation + place
        ndc = focal * [x, y] / z + centre
        scale = np.array(size) / 2 if kind != "ndc_isotropic" else min(size) / 2
        expected = np.array(size) / 2 - scale * ndc
        np.testing.assert_allclose(camera.project(point)[:2], expected, rtol=0, atol=1e-9)
    assert image_file.mask is None and (camera.width, camera.height) == size


def test_set_lists_of_version_1(tmp_path):
    many = views()
    co3d.write(tmp_path, {"train": many[:6], "test": many[6:]}, 1)
    folder = tmp_path / "object" / "sequence"
    file = folder.parent / "set_lists.json"
    rows = [row for listed in json.loads(file.read_text()).values() for row in listed]
    lists = {"train_known": rows[:3], "test_known": rows[3:5], "test_unseen": rows[5:7]}
    lists["train_unseen"] = [["another", 0, "object/another/images/a.png"], *rows[7:8]]
    file.write_text(json.dumps(lists))
    assert [len(read_split(folder, split, [])) for split in ("train", "test")] == [5, 3]


def test_the_first_set_list_with_both_splits_counts(sequence):
    """The test frames of fewview_train include its training frames, which must not be tested."""
    lists = sequence.parent / "set_lists"
    many = lists / "set_lists_manyview_dev_0.json"
    rows = [row for listed in json.loads(many.read_text()).values() for row in listed]
    few = {"train": rows[:4], "test": rows[:6], "val": rows[6:7]}
    (lists / "set_lists_fewview_train.json").write_text(json.dumps(few))
    (lists / "set_lists_fewview_aaa.json").write_text(json.dumps({"train": rows, "test": rows}))
    assert len(read_split(sequence, "test", [])) == 2, "many views go first"
    many.unlink()
    counts = {split: len(read_split(sequence, split, [])) for split in ("train", "test", "val")}
    assert counts == {"train": 4, "test": 2, "val": 1}


def test_without_lists_every_eighth_is_held_out(sequence):
    for file in (sequence.parent / "set_lists").iterdir():
        file.unlink()
    numbers = [int(p.name[-10:-4]) for p in read_split(sequence, "test", [])]
    assert numbers == [0, 8] and len(read_split(sequence, "train", [])) == 9


def test_a_linked_sequence(sequence):
    """The sequence may be a link to another disk; its annotations lie beside the link. A frame with
    an empty mask is left out.
    """
    edit(sequence, lambda frame: frame["mask"].update(mass=0))
    elsewhere = sequence.parent.parent / "elsewhere"
    sequence.rename(elsewhere)
    sequence.symlink_to(elsewhere)
    assert [len(read_split(sequence, split, [])) for split in ("train", "test")] == [8, 2]


def view_change(**keys):
    return lambda frame: frame["viewpoint"].update(keys)


def image_at(path):
    return lambda frame: frame["image"].update(path=path)


BAD = {
    "no viewpoint": (lambda f: f.pop("viewpoint"), "[3].viewpoint:"),
    "focal length denormal": (view_change(focal_length=[5e-324, 1]), "[3].focal_length:"),
    "mass in words": (lambda f: f["mask"].update(mass="some"), "[3].mass:"),
    "unknown NDC": (view_change(intrinsics_format="pixels"), "[3].intrinsics_format:"),
    "no image": (lambda f: f.update(image=None), "[3].image:"),
    "another sequence": (image_at("object/other/images/frame000000.png"), "[3].image:"),
    "image outside": (image_at("object/sequence/../../../x.png"), "leaves the scene's folder"),
    "no frame number": (lambda f: f.pop("frame_number"), "[3].frame_number:"),
}


# in the other cases, a training leaves the frame out
REFUSED = ("no frame number", "mass in words")  # the frames' order needs these keys


@pytest.mark.parametrize("case", BAD)
def test_bad_frame(sequence, case):
    change, place = BAD[case]
    for file in (sequence.parent / "set_lists").iterdir():
        file.unlink()
    write_png(sequence.parent.parent.parent / "x.png", np.zeros((22, 30, 3)))
    edit(sequence, change)
    check = refused if case in REFUSED else left_out
    check(sequence, sequence.parent / ANNOTATIONS, place)


BAD_FILES = {
    "no gzip": (ANNOTATIONS, b"[]"),
    "cut gzip": (ANNOTATIONS, gzip.compress(b"[" + b"1," * 9999)[:40]),
    "no JSON": (ANNOTATIONS, gzip.compress(b"{")),
    "list of numbers": (ANNOTATIONS, gzip.compress(b"[1, 2]")),
    "another sequence": (ANNOTATIONS, gzip.compress(b"[]")),
    "set list": ("set_lists.json", b'{"train_known": [1]}'),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_file(sequence, case):
    name, content = BAD_FILES[case]
    (sequence.parent / name).write_bytes(content)
    refused(sequence, sequence.parent / name)


@pytest.mark.parametrize("bound, words", [("TEXT", "1000 c"), ("FRAMES", "10 f"), ("SUM", "5 c")])
def test_annotations_beyond_all_bounds(sequence, monkeypatch, bound, words):
    monkeypatch.setattr(f"pp_cl.scene.readers.co3d.MOST_{bound}", int(words[:-2]))
    refused(sequence, sequence.parent / ANNOTATIONS, words)
