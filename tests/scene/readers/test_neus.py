from pathlib import Path

import numpy as np
import pytest
from support.same_scene import held_out, same, views
from support.transforms_scenes import left_out, refused

from pp_cl.config import assign, configure, preset
from pp_cl.files.image import write_png
from pp_cl.scene.listing import scene_box, scene_frames
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers.neus import box, read_split
from tools.scene_formats import neus

FILE = "cameras_sphere.npz"


@pytest.fixture
def scene(tmp_path):
    neus.write(tmp_path, held_out(views()))
    return tmp_path


def edit(folder, change):
    with np.load(folder / FILE) as stored:
        arrays = dict(stored)
    change(arrays)
    np.savez(folder / FILE, **arrays)


@pytest.mark.parametrize("scale", [1.0, 1e-4, 3e5])
def test_a_projection_is_known_up_to_its_scale(tmp_path, scale):
    splits = held_out(views())
    neus.write(tmp_path, splits)
    edit(tmp_path, lambda a: a.update({name: scale * matrix for name, matrix in a.items()}))
    for name, other in ((FILE, "cameras.npz"), ("image", "images"), ("mask", "masks")):
        (tmp_path / name).rename(tmp_path / other)
    same(tmp_path, splits)


def test_a_projection_by_hand(tmp_path):
    """The matrix is K [R | t]: a camera at (1, 2, 3) looks along +x, its image's right is -y and
    its down is -z. R has the camera's axes as rows, t = -R c.
    """
    rotation = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    world = np.array([[50, 0, 16], [0, 40, 10], [0, 0, 1]]) @ np.column_stack(
        [rotation, [2, 3, -1]]
    )
    (tmp_path / "image").mkdir()
    write_png(tmp_path / "image" / "0.png", np.zeros((22, 30, 3)))
    np.savez(tmp_path / FILE, world_mat_0=world, world_mat_inv_0=np.eye(4))
    [image_file] = read_split(tmp_path, "test", [])
    camera = image_file.camera
    np.testing.assert_allclose(camera.pose[:, :3], rotation.T, atol=1e-12)
    np.testing.assert_allclose(camera.eye, (1, 2, 3), atol=1e-12)
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (50, 40, 16, 10))
    assert image_file.depth_range is None


def test_the_box_is_that_of_the_stated_sphere(scene):
    assert box(scene) is None
    edit(scene, lambda a: a.update(scale_mat_0=np.diag([2.0, 2, 2, 1]) + 0))
    np.testing.assert_allclose(box(scene), [[-2] * 3, [2] * 3])
    config = configure(preset("tiny"), str(scene))
    np.testing.assert_allclose(scene_box(config), [[-2] * 3, [2] * 3])
    assign(config, "scene.box", "0,0,0,1,1,1", "test")
    np.testing.assert_allclose(scene_box(config), [[0] * 3, [1] * 3])


def test_the_sphere_gives_the_depth_range(scene):
    """Its centre is (0.1, 0, 0.2), its radius 0.5."""
    matrix = np.diag([0.5, 0.5, 0.5, 1])
    matrix[:3, 3] = 0.1, 0, 0.2
    edit(scene, lambda a: a.update({f"scale_mat_{i}": matrix for i in range(11)}))
    for image_file in read_split(scene, "train", []):
        distance = np.linalg.norm(image_file.camera.eye - [0.1, 0, 0.2])
        assert image_file.depth_range == pytest.approx((distance - 0.5, distance + 0.5))
    matrix = np.diag([10.0, 10, 10, 1])  # this sphere contains the cameras
    edit(scene, lambda a: a.update({f"scale_mat_{i}": matrix for i in range(11)}))
    near, far = read_split(scene, "train", [])[0].depth_range
    assert near == pytest.approx(1e-2) and far > 10


def world(change):
    def changed(arrays):
        arrays["world_mat_2"] = change(arrays["world_mat_2"].copy())

    return changed


def skewed(matrix):
    matrix[:3] = np.array([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]) @ matrix[:3]
    return matrix


def scale(matrix):
    return lambda arrays: arrays.update(scale_mat_2=np.array(matrix))


BAD = {
    "missing": (lambda a: a.pop("world_mat_2"), "world_mat_2: is missing"),
    "one more": (lambda a: a.update(world_mat_11=np.eye(4)), "12 cameras"),
    "numbered from 1": (lambda a: a.update(world_mat_11=a.pop("world_mat_2")), "world_mat_2"),
    "mirrored": (world(lambda m: m @ np.diag([-1, 1, 1, 1])), "world_mat_2"),
    "negated": (world(np.negative), "world_mat_2"),
    "shape": (world(lambda m: m[:2]), "world_mat_2"),
    "singular": (world(np.zeros_like), "world_mat_2"),
    "skew": (world(skewed), "world_mat_2"),
    "scale of another shape": (scale(np.eye(2)), "scale_mat_2"),
    "scale 0": (scale(np.zeros((4, 4))), "scale_mat_2"),
    "scale sheared": (scale(np.diag([1.0, 2, 1, 1])), "scale_mat_2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_cameras(scene, case):
    change, word = BAD[case]
    edit(scene, change)
    check = left_out if word.endswith("_2") and case != "numbered from 1" else refused
    check(scene, scene / FILE, word)


def test_masks_belong_to_images_of_their_number(scene, dev):
    """In DTU, mask/000.png belongs to image/000000.png; a mask of another number to none."""
    before = [view.name for view in scene_frames(scene)]
    for file in (scene / "mask").iterdir():
        file.rename(file.with_name(f"{int(file.stem):03d}.png"))
    assert [Path(view.mask).stem for view in scene_frames(scene)] == [
        Path(name).stem[3:] for name in before
    ]
    (scene / "mask" / "010.png").rename(scene / "mask" / "011.png")
    with pytest.warns(UserWarning, match=r"without a mask .* .image/000010\.png"):
        load_scene(scene, dev=dev)
