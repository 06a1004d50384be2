"""Placing from matches that are made up: cameras around a ball before a uniform background."""

import numpy as np
import pytest
from PIL import Image

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_studio.capture import poses
from pp_studio.capture.features import LENS, quiet, verification
from tools.capture_demo import align

colmap = pytest.importorskip("pycolmap")

SIZE, FOCAL, DISTANCE, STEPS, COUNT = 320, 444, 3.4, 60, 900
REACH = 5  # steps to the views with which a view is matched
APART = 25  # steps by which a part of the pattern repeats
REPEATS = 0.35  # share of the points that do
NOISE = 0.3  # pixels


def ring(steps=STEPS):
    found = []
    for turn in np.arange(steps) * 2 * np.pi / STEPS:
        ahead = np.array([np.cos(turn) * 0.94, np.sin(turn) * 0.94, 0.34])
        eye = DISTANCE * ahead
        found.append(Camera.look_at(eye, (0, 0, 0), fx=FOCAL, width=SIZE, height=SIZE))
    return found


def pattern(rng):
    """((N, 3) points on a ball, (N,) the kind of each: points of a kind look alike)."""
    points = rng.normal(size=(COUNT, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    turn = 2 * np.pi * APART / STEPS
    turned = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    alike = points[: int(REPEATS * COUNT)] @ turned.T
    return np.concatenate([points, alike]), np.append(np.arange(COUNT), np.arange(len(alike)))


def matched(folder, rng, k1=0.0, steps=STEPS):
    """(database, images, facts) of photographs of the ball, with the matches of features of a kind,
    the fewer the farther apart the views are.
    """
    (images := folder / "images").mkdir()
    names = [f"{i:03d}.png" for i in range(steps)]
    for name in names:
        Image.new("L", (SIZE, SIZE)).save(images / name)
    points, kinds = pattern(rng)
    with quiet(folder), colmap.Database.open(folder / "database.db") as db:
        options = colmap.ImageReaderOptions(camera_model=LENS)
        colmap.import_images(
            folder / "database.db", images, colmap.CameraMode.SINGLE, names, options
        )
        ids = [db.read_image_with_name(name).image_id for name in names]
        shown = []
        for number, camera in zip(ids, ring(steps), strict=True):
            faces = points @ (camera.eye / DISTANCE) > 0.8 * 0.5
            own = kinds[faces]
            once = np.isin(own, np.flatnonzero(np.bincount(own) == 1))
            x, y, _ = camera.project(points[faces][once])
            plane = (np.stack([x, y], 1) - SIZE / 2) / FOCAL
            plane *= 1 + k1 * (plane**2).sum(1, keepdims=True)
            pixels = FOCAL * plane + SIZE / 2 + rng.normal(0, NOISE, plane.shape)
            db.write_keypoints(number, pixels.astype(np.float32))
            shown.append(own[once])
        for i in range(steps):
            for step in (*range(1, REACH + 1), *range(APART - 2, APART + 3)):
                j = (i + step) % STEPS
                if j >= steps or j == i:
                    continue
                _, a, b = np.intersect1d(shown[i], shown[j], return_indices=True)
                away = step if step <= REACH else abs(step - APART)
                kept = rng.uniform(size=len(a)) < np.exp(-away / 2)
                pair = np.stack([a[kept], b[kept]], 1).astype(np.uint32)
                db.write_matches(ids[i], ids[j], pair)
        colmap.geometric_verification(
            folder / "database.db", two_view_geometry_options=verification(colmap)
        )
    taken = [{"name": name, "sharpness": 1.0} for name in names]
    return folder / "database.db", images, taken


def test_a_pattern_that_repeats_does_not_move_cameras_to_its_other_side(tmp_path, rng):
    database, images, taken = matched(tmp_path, rng)
    found = poses.place(database, images, tmp_path / "model", taken, True)
    assert found["placed"] == STEPS
    placed = poses.image_files(colmap.Reconstruction(tmp_path / "model"))
    off = align([one.camera for one in placed], ring())
    assert off.position < 0.02 and off.degrees < 0.5
    assert placed[0].lens.k1 == 0


def test_a_camera_beside_its_place_is_noticed(tmp_path, rng, monkeypatch):
    """Its matches with its neighbours are no points of theirs."""
    database, images, taken = matched(tmp_path, rng, steps=16)
    poses.place(database, images, tmp_path / "model", taken, True)
    model = colmap.Reconstruction(tmp_path / "model")
    assert poses.contradictions(database, model) == []
    (image,) = (one for one in model.images.values() if one.name == "009.png")
    for index, point in enumerate(image.points2D):
        if point.has_point3D():
            model.delete_observation(image.image_id, index)
    wrong = poses.contradictions(database, model)
    assert wrong and all("009.png" in pair for pair in wrong)
    monkeypatch.setattr(poses, "_mapped", lambda *_: [model])
    with pytest.raises(UserError, match=f"{wrong[0][0]} and {wrong[0][1]} .* cameras are wrong"):
        poses.place(database, images, tmp_path / "other", taken, True)


@pytest.mark.slow
def test_a_lens_that_distorts_is_found(tmp_path, rng):
    database, images, taken = matched(tmp_path, rng, k1=-1.0)
    poses.place(database, images, tmp_path / "model", taken, True)
    placed = poses.image_files(colmap.Reconstruction(tmp_path / "model"))
    assert placed[0].lens.k1 == pytest.approx(-1, abs=0.2)
    off = align([one.camera for one in placed], ring())
    assert off.position < 0.02 and off.degrees < 0.5
