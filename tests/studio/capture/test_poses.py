"""Placing by matches that are made up: of a ball's points, by cameras around it."""

import numpy as np
import pytest
from PIL import Image

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_studio.capture import poses
from pp_studio.capture.features import LENS, quiet, verification
from tools.capture_demo import align

colmap = pytest.importorskip("pycolmap")

SIZE, FOCAL, DISTANCE, STEPS, COUNT = 320, 444, 3.4, 36, 600
REACH = 4  # steps to the views with which a view is matched
FADES = 2.0  # steps after which a feature matches a third as often
NOISE = 0.3  # pixels


def ring(steps=STEPS):
    cameras = []
    for turn in np.arange(steps) * 2 * np.pi / STEPS:
        eye = DISTANCE * np.array([np.cos(turn) * 0.94, np.sin(turn) * 0.94, 0.34])
        cameras.append(Camera.look_at(eye, (0, 0, 0), fx=FOCAL, width=SIZE, height=SIZE))
    return cameras


def matched(folder, rng, k1=0.0, steps=STEPS, zoom=1.0, count=COUNT):
    """(database, images, facts) of photographs with a lens of distortion k1, and their matches.
    zoom: of every third.
    """
    (images := folder / "images").mkdir()
    database, names = folder / "database.db", [f"{i:03d}.png" for i in range(steps)]
    for name in names:
        Image.new("L", (SIZE, SIZE)).save(images / name)
    points = rng.normal(size=(count, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    with quiet(folder), colmap.Database.open(database) as db:
        options = colmap.ImageReaderOptions(camera_model=LENS)
        colmap.import_images(database, images, colmap.CameraMode.SINGLE, names, options)
        ids, shown = [db.read_image_with_name(name).image_id for name in names], []
        for i, (number, camera) in enumerate(zip(ids, ring(steps), strict=True)):
            shown.append(np.flatnonzero(points @ camera.eye > 0.4 * DISTANCE))
            plane = (np.stack(camera.project(points[shown[-1]])[:2], 1) - SIZE / 2) / FOCAL
            plane *= 1 + k1 * (plane**2).sum(1, keepdims=True)
            focal = FOCAL * (zoom if i % 3 == 0 else 1)
            pixels = focal * plane + SIZE / 2 + rng.normal(0, NOISE, plane.shape)
            db.write_keypoints(number, pixels.astype(np.float32))
        for i in range(steps):
            for j in range(i + 1, steps):
                if (away := min(j - i, STEPS - j + i)) <= REACH:
                    _, *pair = np.intersect1d(shown[i], shown[j], return_indices=True)
                    kept = rng.uniform(size=len(pair[0])) < np.exp(-away / FADES)
                    db.write_matches(ids[i], ids[j], np.stack(pair, 1)[kept].astype(np.uint32))
        colmap.geometric_verification(database, two_view_geometry_options=verification(colmap))
    return database, images, [{"name": name, "sharpness": 1.0} for name in names]


def test_a_camera_beside_its_place_is_noticed(tmp_path, rng, monkeypatch):
    """Its matches with its neighbours are no points of theirs."""
    database, images, taken = matched(tmp_path, rng, steps=16)
    poses.place(database, images, tmp_path / "model", taken, True)
    model = colmap.Reconstruction(tmp_path / "model")
    assert poses.contradictions(database, model) == []
    (image,) = (image for image in model.images.values() if image.name == "009.png")
    for index, point in enumerate(image.points2D):
        if point.has_point3D():
            model.delete_observation(image.image_id, index)
    wrong = poses.contradictions(database, model)
    assert wrong and all("009.png" in pair for pair in wrong)
    monkeypatch.setattr(poses, "_mapped", lambda *_: [model])
    with pytest.raises(UserError, match=f"{wrong[0][0]} and {wrong[0][1]} .* cameras are wrong"):
        poses.place(database, images, tmp_path / "other", taken, True)


@pytest.mark.parametrize("k1", [0.0, -1.0])
def test_a_lens_is_straight_unless_it_distorts(tmp_path, rng, k1):
    """Around a turned object; -1 moves the edges of the ball by 6 pixels."""
    database, images, taken = matched(tmp_path, rng, k1)
    assert poses.place(database, images, tmp_path / "model", taken, True)["placed"] == STEPS
    placed = poses.image_files(colmap.Reconstruction(tmp_path / "model"))
    distortion = placed[0].lens.k1
    assert distortion == pytest.approx(k1, abs=-0.2 * k1)
    off = align([image_file.camera for image_file in placed], ring())
    assert off.position < 0.02 and off.degrees < 0.5


@pytest.mark.parametrize("zoom", [1.0, 1.5])
def test_a_zoom_that_no_tag_states(tmp_path, rng, zoom):
    database, images, taken = matched(tmp_path, rng, zoom=zoom, count=4 * COUNT)
    facts = poses.place(database, images, tmp_path / "model", taken, False)
    assert facts["placed"] == STEPS
    placed = [
        image_file.camera
        for image_file in poses.image_files(colmap.Reconstruction(tmp_path / "model"))
    ]
    off = align(placed, ring())
    assert off.position < 0.01 * DISTANCE and off.degrees < 0.5
    focal = np.array([camera.fx for camera in placed])
    assert np.allclose(focal[::3] / focal[1::3], zoom, rtol=0.02)
    assert ("12 with 1." in facts["zoomed"]) == (zoom > 1)
