import json
import shutil

import numpy as np
import pytest
from support.same_scene import views
from support.transforms_scenes import SIZE, refused, write_scene

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lens import BAND_BYTES, LensDistortion
from pp_cl.scene.listing import list_split, scene_frames, scene_splits
from pp_cl.scene.load import BAND_COPIES, load_scene, reading_cost
from pp_cl.settings import SceneConfig
from tools.scene_formats import nerfstudio


def test_missing_folder_format_and_split(tmp_path):
    scene, above = tmp_path / "above" / "scene", tmp_path / "above"
    (scene / "images").mkdir(parents=True)
    refused(tmp_path / "none", tmp_path / "none", "no such folder", "demo")
    write_png(scene / "a.png", np.zeros((8, 8, 3)))
    refused(scene, scene, "no scene in it: 'a.png', 'images', but no known file", "pp-cl capture")
    write_scene(scene)
    (scene / "transforms_train.json").rename(scene / "cameras.json")
    refused(scene, "'cameras.json' has frames; is it a transforms.json?")
    (scene / "cameras.json").rename(scene / "transforms_train.json")
    refused(scene / "transforms_train.json", "is a file", scene)
    (scene / "a.mov").touch()
    refused(scene / "a.mov", "is a file", f"pp-cl capture {scene / 'a.mov'} --out SCENE")
    refused(scene / "images", f"no scene in it; {scene} is one")
    refused(above, f"no scene in it; {scene} is one")
    write_scene(scene, "val")
    refused(scene, scene, "no split test", "train, val", splits=("test",))


def test_a_split_without_images(tmp_path):
    """The first of every eight images is for testing, so a single one leaves none for training."""
    nerfstudio.write(tmp_path, {"train": views(1)})
    file = tmp_path / "transforms.json"
    file.write_text(file.read_text().replace("train_filenames", "names"))
    assert len(load_scene(tmp_path, ("test",)).splits["test"]) == 1
    refused(tmp_path, tmp_path, "split train has no images")


@pytest.mark.parametrize("left", [0, 3])
def test_cameras_of_a_test_without_images_are_no_split(tmp_path, left):
    write_scene(tmp_path)
    write_scene(tmp_path, "test", edit=lambda data: data.update(frames=data["frames"][:left]))
    for image in tmp_path.glob("test_*.png"):
        image.unlink()
    assert scene_splits(tmp_path) == ["train"]


def test_some_views_of_a_split_are_read_and_no_others(tmp_path):
    write_scene(tmp_path)
    names = [view.name for view in load_scene(tmp_path).splits["train"]]
    (tmp_path / names[1]).write_bytes((tmp_path / names[1]).read_bytes()[:-200])
    few = load_scene(tmp_path, most=1).splits["train"]
    assert [view.name for view in few] == names[:1]


@pytest.mark.parametrize(
    "lens, source, factor, workers, per_pixel",
    [
        (LensDistortion(), "given", 1, 3, 18),
        (LensDistortion(k1=0.1), "given", 3, 3, 18),
        (LensDistortion(), "color", 1, 1, 178),
        (LensDistortion(k1=0.1), "color", 4, 2, 28),
    ],
)
def test_as_many_images_are_read_at_once_as_memory_holds(
    monkeypatch, lens, source, factor, workers, per_pixel
):
    """On many cores, images of 12 megapixels in float64 would take gigabytes if all were read at
    once.
    """
    monkeypatch.setattr("pp_cl.scene.load.os.cpu_count", lambda: 64)
    camera = Camera(np.eye(3, 4), 4000, 4000, 2000, 1500, 4000, 3000)
    phone = ImageFile("a.jpg", camera, lens=lens)
    cost = reading_cost([phone] * 300, SceneConfig(mask_from=source), factor)
    bands = BAND_COPIES * BAND_BYTES if lens else 0
    assert cost == (workers, workers * per_pixel * 12_000_000 + bands)
    small = ImageFile("b.jpg", camera.downscaled(10))
    assert reading_cost([small] * 300)[0] == 64 and reading_cost([small] * 5)[0] == 5


def test_depth_range_of_some_views_only(tmp_path):
    write_scene(tmp_path, edit=lambda data: data["frames"][2].update(near=1, far=2))
    ranges = [view.depth_range for view in load_scene(tmp_path).splits["train"]]
    assert ranges == [None, None, (1, 2)]


def test_an_image_that_cannot_be_reduced_costs_its_view(tmp_path):
    write_scene(tmp_path, count=10)
    write_png(tmp_path / "train_4.png", np.ones((SIZE[1] // 2, SIZE[0] // 2, 4)))
    with pytest.warns(UserWarning, match=r"train: 1 of 10 views left out.*train_4\.png"):
        assert len(load_scene(tmp_path, downscale=1).splits["train"]) == 9


@pytest.mark.parametrize("listed", (True, False))
def test_pictures_that_are_there_twice(tmp_path, listed):
    (tmp_path / "images").mkdir()
    data = write_scene(tmp_path / "images", count=20)
    frames = data["frames"]
    for i, frame in enumerate(frames):
        frame["file_path"] = f"images/{i:02d}_a.png"
        (tmp_path / f"images/train_{i}.png").rename(tmp_path / frame["file_path"])
        shutil.copy(tmp_path / frame["file_path"], tmp_path / f"images/{i:02d}_b.png")
    data["frames"] = frames + [f | {"file_path": f["file_path"][:-5] + "b.png"} for f in frames]
    if listed:
        data["train_filenames"] = [f"images/{i:02d}_a.png" for i in range(20)]
        data["test_filenames"] = ["images/03_b.png", "images/05_b.png"]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    splits = [
        {file.name.partition("_")[0] for file in list_split(tmp_path, split).image_files}
        for split in ("train", "test")
    ]
    if listed:
        with pytest.warns(UserWarning, match=r"test: .*in training, too.*03_b\.png, .*05_b\.png"):
            scene_frames(tmp_path, "test")
    else:
        assert not splits[0] & splits[1] and len(splits[1]) == 3


EXPORTED = {
    "doc.xml": "perhaps Metashape's",
    "cameras.csv": "perhaps RealityCapture's",
    "cams/00000000_cam.txt": "BlendedMVS's",
    "keyframes/corrected_cameras/1.json": "Polycam's",
    "cameras.sfm": "Meshroom's; write COLMAP's files with `aliceVision_exportColmap`",
    "sfm_data.json": "OpenMVG's; write COLMAP's files with `openMVG_main_openMVG2Colmap`",
    "reconstruction.json": "perhaps OpenSfM's",
    "scene.nvm": "VisualSFM's",
    "bundle.rd.out": "Bundler's",
}


@pytest.mark.parametrize("name", EXPORTED)
def test_files_of_other_programs_are_named(tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("{}")
    refused(tmp_path, f"is {EXPORTED[name]}", "; ")


@pytest.mark.parametrize(
    "key, value, told",
    [
        ("fl_y", 5e-324, "focal lengths"),
        ("fl_x", 1e15, "focal lengths"),
        ("camera_angle_y", 3.14159, "focal lengths"),
        ("cx", 1e29, "principal point"),
        ("cy", -1e29, "principal point"),
    ],
)
def test_lenses_that_float32_cannot_hold(tmp_path, key, value, told):
    write_scene(tmp_path, edit=lambda data: data["frames"][1].update({key: value}))
    refused(tmp_path, tmp_path / "train_1.png", told, "correct")
    with pytest.raises(UserError, match=told):
        scene_frames(str(tmp_path))


def test_a_folder_that_may_not_be_read(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, _: path != tmp_path)
    refused(tmp_path, tmp_path, "cannot be read; check its permissions")
