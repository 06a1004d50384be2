"""Cameras that are wrong in the ways of known programs are refused with the reading that is right,
and accepted in it; wrong masks of some views are not taken for wrong cameras.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.same_scene import held_out
from support.scenes import ring_cameras

from pp_cl.config import configure, preset
from pp_cl.engine.views import View
from pp_cl.files.image import ORIENTATION, read_rgba, write_png
from pp_cl.scene.conventions import read_as
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.load import open_scene
from pp_cl.scene.readers.frame import GL_FROM_CV
from pp_cl.scene.verdict import MOST_BESIDE, WrongCameras, judged
from tools.convert_scene import convert

COUNT, SIZE = 20, 64
BALLS = [
    ((0.1, 0, -0.2), 0.3),
    ((0.8, 0.2, 0.4), 0.25),
    ((-0.4, 0.5, 0.7), 0.2),
    ((0, -0.8, 0), 0.2),
]
SWAP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # swaps y and z


def balls(camera):
    """(H, W, 4) uint8 image of an object without symmetry."""
    rays = camera.rays() / np.linalg.norm(camera.rays(), axis=-1, keepdims=True)
    shown = np.zeros(rays.shape[:2], bool)
    for place, radius in BALLS:
        towards = np.array(place) - camera.eye
        shown |= (rays @ towards) ** 2 > towards @ towards - radius**2
    return np.dstack([127 * rays + 128, 255 * shown]).astype(np.uint8)


def whole(camera):
    return np.vstack([camera.pose, [0, 0, 0, 1]])


def posed(change):
    """A function that applies change() to the views' 4x4 camera-to-world matrices."""

    def changed(views):
        poses = [change(whole(view.stored_camera))[:3] for view in views]
        cameras = [replace(v.stored_camera, pose=p) for v, p in zip(views, poses, strict=True)]
        return [replace(v, stored_camera=c) for v, c in zip(views, cameras, strict=True)]

    return changed


def pictured(change):
    return lambda views: [replace(v, image=np.ascontiguousarray(change(v.image))) for v in views]


def scalar_last(pose):
    x, y, z, w = Rotation.from_matrix(pose[:3, :3].T).as_quat()
    read = Rotation.from_quat([y, z, w, x]).as_matrix()  # the file's x, y, z, w, read as w, x, y, z
    return np.column_stack([read.T, read.T @ pose[:3, :3].T @ pose[:3, 3]])


def centre_for_translation(pose):
    return np.column_stack([pose[:3, :3], -pose[:3, :3] @ pose[:3, 3]])


def unity(pose):
    return SWAP @ pose @ GL_FROM_CV @ np.diag([1, 1, -1, 1]) @ GL_FROM_CV


def oblong(views):
    lenses = [replace(v.stored_camera, fy=1.8 * v.stored_camera.fy) for v in views]
    return [replace(v, stored_camera=c) for v, c in zip(views, lenses, strict=True)]


def off_by_one(views):
    cameras = [view.stored_camera for view in views]
    before = [cameras[-1], *cameras[:-1]]
    return [replace(v, stored_camera=c) for v, c in zip(views, before, strict=True)]


def unpadded(folder):
    for place in ("images", "masks"):
        for file in sorted((folder / place).iterdir()):
            file.rename(file.with_name(f"f{int(file.name[:6])}{file.name[6:]}"))


def mirrored_axis(folder):
    for file in folder.glob("transforms*.json"):
        data = json.loads(file.read_text())
        for frame in data["frames"]:
            matrix = np.array(frame["transform_matrix"]) @ np.diag([1, 1, -1, 1])
            frame["transform_matrix"] = matrix.tolist()
        file.write_text(json.dumps(data))


def lying(folder):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    for file in folder.rglob("*.png"):
        Image.open(file).transpose(Image.Transpose.ROTATE_90).save(file, exif=exif)


def same(given):
    return given


# {what is wrong: (format, change of the views, change of the folder, the right reading)}
WRONG = {
    "scalar last": ("colmap", posed(scalar_last), same, "xyzw"),
    "centres": ("colmap", posed(centre_for_translation), same, "centres"),
    "camera-to-world": ("colmap", posed(np.linalg.inv), same, "camera-to-world"),
    "Blender's": (
        "colmap",
        posed(lambda pose: np.linalg.inv(pose @ GL_FROM_CV)),
        same,
        "opengl camera-to-world",
    ),
    "Unity's": ("nerf_synthetic", posed(unity), same, "left-handed"),
    "an axis mirrored": ("nerf_synthetic", same, mirrored_axis, "left-handed"),
    "mirrored": ("neus", pictured(lambda image: image[:, ::-1]), same, "mirrored"),
    "upside down": ("colmap", pictured(lambda image: image[::-1, ::-1]), same, "upside-down"),
    "OpenGL's axes": ("nsvf", posed(lambda pose: pose @ GL_FROM_CV), same, "opengl"),
    "from the world": ("nsvf", posed(np.linalg.inv), same, "world-to-camera"),
    "OpenCV's axes, from the world": (
        "nerf_synthetic",
        posed(lambda pose: np.linalg.inv(pose) @ GL_FROM_CV),
        same,
        "opencv world-to-camera",
    ),
    "oblong pixels": ("colmap", oblong, same, "square-pixels"),
    "off by one": ("colmap", off_by_one, same, "next"),
    "numbers without zeros": ("llff", same, unpadded, "by-number"),
    "EXIF": ("nerf_synthetic", same, lying, "exif"),
}


def written(folder, form="colmap", change=same):
    cameras = ring_cameras(COUNT, SIZE)
    views = [View(f"{i:06d}.png", camera, balls(camera)) for i, camera in enumerate(cameras)]
    convert(held_out(change(views)), folder, form)
    return folder


def judge(dev, folder):
    return judged(dev, configure(preset("tiny"), str(folder)), open_views(dev, folder))


@pytest.mark.parametrize("what", WRONG)
def test_the_reading_in_which_cameras_are_right(dev, tmp_path, what):
    form, views, change, reading = WRONG[what]
    folder = written(tmp_path / "scene", form, views)
    change(folder)
    with pytest.raises(WrongCameras) as caught:
        judge(dev, folder)
    edits = json.dumps({"axes": reading})
    assert f"write {edits} into {folder / 'pp_cl.json'}" in str(caught.value)
    (folder / "pp_cl.json").write_text(edits)
    agreement, beside = judge(dev, folder)
    assert beside < MOST_BESIDE / 10 and not agreement.left_out
    (folder / "pp_cl.json").write_text('{"axes": "stated"}')
    assert "be right as" not in refusal(dev, folder)


def refusal(dev, folder):
    try:
        judge(dev, folder)
    except Exception as error:
        return str(error)
    return ""


def test_cameras_that_no_reading_mends(dev, tmp_path, rng):
    folder = written(
        tmp_path / "scene",
        change=posed(
            lambda pose: pose @ np.block([[turn(rng), np.zeros((3, 1))], [np.eye(4)[3:]]])
        ),
    )
    assert "in a way that pp-cl does not know" in refusal(dev, folder)


def turn(rng):
    return Rotation.from_rotvec(rng.normal(0, 0.2, 3) * [0.2, 0.2, 1]).as_matrix()


@pytest.mark.parametrize("count", [0, 1, 4])
def test_wrong_masks_of_some_are_no_wrong_cameras(dev, tmp_path, count):
    folder = written(tmp_path / "scene", "nerf_synthetic")
    for file in sorted(Path(folder).rglob("*.png"))[4 : 4 + count]:
        image = read_rgba(file)
        image[:36, 20:40] = 0
        write_png(file, image)
    _, beside = judge(dev, folder)
    assert beside == 0 if count == 0 else beside > MOST_BESIDE


@pytest.mark.parametrize("axes, order", [("by-number next", "c b a"), ("next by-number", "b a c")])
def test_two_orders_are_read_one_after_the_other(axes, order):
    cameras = dict(zip("abc", ring_cameras(3, 8), strict=True))  # of 1.png, 2.png and 10.png
    files = [
        ImageFile(f"{i}.png", camera)
        for i, camera in zip((1, 2, 10), cameras.values(), strict=True)
    ]
    read = read_as(files, axes, ("camera-to-world", "opengl"))
    for image_file, name in zip(read, order.split(), strict=True):
        np.testing.assert_array_equal(image_file.camera.pose, cameras[name].pose)


def test_pictures_are_turned_where_their_masks_fit_only_so(dev, tmp_path):
    folder = written(tmp_path / "scene", "colmap", lambda views: [backed(view) for view in views])
    before = open_views(dev, folder)
    lying(folder / "images")
    with pytest.warns(UserWarning, match="turned as their EXIF says, as only then their masks fit"):
        after = open_views(dev, folder)
    for view, turned in zip(before, after, strict=True):
        assert np.array_equal(view.image, turned.image)


def backed(view):
    """The view with a background, which its mask leaves in the picture, and a brighter object."""
    image = view.image.copy()
    image[..., :3] = np.where(image[..., 3:] > 0, 128 + image[..., :3] // 2, image[..., :3] // 4)
    return replace(view, image=image)


def open_views(dev, folder):
    return open_scene(dev, configure(preset("tiny"), str(folder)), ("train",)).splits["train"]
