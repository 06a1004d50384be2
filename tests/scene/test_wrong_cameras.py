"""Wrong cameras among right ones are found, and no right one is named."""

from dataclasses import replace

import numpy as np
import pytest

from pp_cl.engine.views import View
from pp_cl.scene import demo
from pp_cl.scene.hull import agreement_of
from pp_cl.scene.wrong_cameras import looking_away, wrong_cameras

COUNT = 24


@pytest.fixture(scope="module")
def views(session_device) -> list[View]:
    return demo.demo_views(session_device, "train", COUNT)


def turned(pose, degrees):
    """The pose turned about the image's upper edge."""
    angle = np.radians(degrees)
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    return np.column_stack([pose[:, :3] @ rotation, pose[:, 3]])


def moved(pose, distances):
    """The pose moved to the right by so many distances from the origin."""
    by = distances * np.linalg.norm(pose[:, 3]) * pose[:, 0]
    return np.column_stack([pose[:, :3], pose[:, 3] + by])


KINDS = {
    "identity": lambda pose: np.eye(3, 4),
    "turned by 180 degrees": lambda pose: turned(pose, 180),
    "turned by 45 degrees": lambda pose: turned(pose, 45),
    "turned by 5 degrees": lambda pose: turned(pose, 5),
    "moved": lambda pose: moved(pose, 0.3),
    "far away": lambda pose: moved(pose, 10),
}


def with_wrong(views, indices, change):
    changed = list(views)
    for i in indices:
        camera = views[i].stored_camera
        changed[i] = replace(views[i], stored_camera=replace(camera, pose=change(camera.pose)))
    return changed


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 3])
def test_wrong_cameras_are_found(views, kind, count):
    for seed in range(3):
        chosen = np.random.default_rng(seed).choice(COUNT, count, replace=False)
        assert {*wrong_cameras(with_wrong(views, chosen, KINDS[kind]))} == {*chosen.tolist()}


def test_swapped_cameras_are_found(views):
    swapped = list(views)
    for i, j in ((3, 11), (11, 3)):
        swapped[i] = replace(views[i], stored_camera=views[j].stored_camera)
    assert {*wrong_cameras(swapped)} == {3, 11}


@pytest.mark.parametrize("most", [7, 8, 24])
def test_no_right_camera_is_named(views, most):
    assert not wrong_cameras(views[:most]) and not looking_away(views[:most])


def test_a_mask_that_lacks_a_part_is_no_wrong_camera(views):
    image = views[5].image.copy()
    rows = np.flatnonzero(image[..., 3].any(1))
    image[: rows[0] + len(rows) // 4, :, 3] = 0
    bitten = [*views[:5], replace(views[5], image=image), *views[6:]]
    assert not wrong_cameras(bitten)


@pytest.mark.parametrize("kind", ["identity", "turned by 180 degrees", "far away"])
def test_without_masks_cameras_are_judged_by_what_they_show(session_device, views, kind):
    opaque = []
    for view in views:
        image = view.image.copy()
        image[..., 3] = 255
        opaque.append(replace(view, image=image))
    wrong = with_wrong(opaque, (4, 17), KINDS[kind])
    assert looking_away(wrong) == [4, 17]
    agreement, _ = agreement_of(session_device, wrong)
    assert {*agreement.left_out} == {views[4].name, views[17].name}
    assert not looking_away(opaque)
    boxed, _ = agreement_of(session_device, wrong, np.array([[-1.0] * 3, [1.0] * 3]))
    assert len(boxed.views) == COUNT, "with a box, views need not show one place"
