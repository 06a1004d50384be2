import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.gltf import glb

from pp_cl.scene.gaze import up_of
from pp_studio.export import texture
from pp_studio.export.formats import export_run
from pp_studio.export.texture import texels, write_textured


def test_texels_are_each_in_one_face(rng):
    """Of two triangles that are a square, up to those on their common edge."""
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9], [0.5, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 4, 4]])
    row, column, face, shares = texels(uv, faces, 40)
    inside = np.zeros((40, 40), int)
    np.add.at(inside, (row, column), 1)
    expected = np.zeros((40, 40), int)
    expected[4:36, 4:36] = 1
    np.fill_diagonal(expected[:, ::-1], 2 * np.diag(expected[:, ::-1]))
    assert np.array_equal(inside, expected) and not (face == 2).any()
    at = np.einsum("nk,nkc->nc", shares, uv[faces[face]])
    assert at[:, 0] * 40 - 0.5 == pytest.approx(column) and shares.sum(1) == pytest.approx(1)
    assert (1 - at[:, 1]) * 40 - 0.5 == pytest.approx(row)


def test_far_from_the_origin_the_file_has_the_same_shape(tmp_path):
    solid = trimesh.creation.box((0.01, 0.02, 0.03))
    visual = trimesh.visual.TextureVisuals(np.zeros((len(solid.vertices), 2)))
    places = solid.vertices + (1e6, -1e6, 1e6 + 0.25)
    far = trimesh.Trimesh(places, solid.faces, visual=visual)
    write_textured(tmp_path / "a.glb", far)
    read = trimesh.load(tmp_path / "a.glb", force="mesh")
    assert np.ptp(read.vertices, axis=0) == pytest.approx((0.01, 0.02, 0.03), abs=1e-6)
    assert read.vertices.mean(0) == pytest.approx(far.vertices.mean(0), abs=1e-6)


def test_it_shows_the_run_with_y_up(run, tmp_path, monkeypatch):
    monkeypatch.setattr(texture, "FACES", 600)
    said = export_run(run, "textured", tmp_path / "a.glb")
    solid = trimesh.load(tmp_path / "a.glb", force="mesh")
    assert said == f"{len(solid.vertices)} vertices, {len(solid.faces)} faces, unlit"
    assert 300 < len(solid.faces) <= 600 and solid.visual.uv.shape == (len(solid.vertices), 2)
    gltf, stored = glb(tmp_path / "a.glb")
    # the light of the photographs is in the texture: lamps would be a second one
    assert gltf["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert gltf["extensionsUsed"] == ["KHR_materials_unlit"]
    outwards = stored["POSITION"] - stored["POSITION"].mean(0)
    assert np.mean((stored["NORMAL"] * outwards).sum(1) > 0) > 0.9
    image = np.asarray(solid.visual.material.baseColorTexture.convert("RGB")) / 255
    up = up_of(run.cameras("train"))
    turn = Rotation.align_vectors([(0, 1, 0)], [up])[0].as_matrix()
    assert np.abs(turn @ up - (0, 1, 0)).max() < 1e-6
    solid.vertices = solid.vertices @ turn
    for camera in run.cameras("test"):
        rendered, rays = run.render(camera), camera.rays().reshape(-1, 3)
        eyes = np.broadcast_to(camera.eye, rays.shape)
        places, ray, face = solid.ray.intersects_location(eyes, rays, multiple_hits=False)
        shares = trimesh.triangles.points_to_barycentric(solid.triangles[face], places)
        uv = (solid.visual.uv[solid.faces[face]] * shares[..., None]).sum(1)
        found = image[((1 - uv[:, 1]) * 256).astype(int) % 256, (uv[:, 0] * 256).astype(int) % 256]
        shown = rendered.rgba().reshape(-1, 4)[ray]
        sure = shown[:, 3] > 0.95
        assert sure.sum() > 150 and np.abs(found - shown[:, :3])[sure].mean() < 0.06
