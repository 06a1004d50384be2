import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.gltf import glb

from pp_cl.errors import UserError
from pp_cl.scene.gaze import up_of
from pp_studio.export import texture
from pp_studio.export.formats import check_target, export_run
from pp_studio.export.texture import agreed, companions, texels, write_textured


def test_texels_are_each_in_one_face(rng):
    """Two triangles form a square; only texels on their common edge are in both."""
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
    line = export_run(run, "textured", tmp_path / "a.glb")
    solid = trimesh.load(tmp_path / "a.glb", force="mesh")
    seen_faces = glb(tmp_path / "a.glb")[0]["meshes"][0]["extras"]["seen_faces"]
    faces_text = f"{len(solid.faces)} faces ({len(solid.faces) - seen_faces} of them guessed)"
    assert line == f"{len(solid.vertices)} vertices, {faces_text}, unlit"
    assert 300 < len(solid.faces) <= 600 and solid.visual.uv.shape == (len(solid.vertices), 2)
    gltf, stored = glb(tmp_path / "a.glb")
    # unlit, as the texture already contains the light of the photographs
    assert gltf["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert gltf["extensionsUsed"] == ["KHR_materials_unlit"]
    outwards = stored["POSITION"] - stored["POSITION"].mean(0)
    assert np.mean((stored["NORMAL"] * outwards).sum(1) > 0) > 0.9
    image = np.asarray(solid.visual.material.baseColorTexture.convert("RGB")) / 255
    up = up_of(run.cameras("train"))
    turn = Rotation.align_vectors([(0, 1, 0)], [up])[0].as_matrix()
    assert np.abs(turn @ up - (0, 1, 0)).max() < 1e-6
    # the cameras look down at the ball, so faces below are guessed
    assert seen_faces > len(solid.faces) / 2 and solid.triangles_center[seen_faces:, 1].max() < 0
    solid.vertices = solid.vertices @ turn
    for camera in run.cameras("test"):
        rendered, rays = run.render(camera), camera.rays().reshape(-1, 3)
        eyes = np.broadcast_to(camera.eye, rays.shape)
        places, ray, face = solid.ray.intersects_location(eyes, rays, multiple_hits=False)
        shares = trimesh.triangles.points_to_barycentric(solid.triangles[face], places)
        uv = (solid.visual.uv[solid.faces[face]] * shares[..., None]).sum(1)
        texel = image[((1 - uv[:, 1]) * 256).astype(int) % 256, (uv[:, 0] * 256).astype(int) % 256]
        shown = rendered.rgba().reshape(-1, 4)[ray]
        sure = shown[:, 3] > 0.95
        assert sure.sum() > 150 and np.abs(texel - shown[:, :3])[sure].mean() < 0.06


def test_an_obj_has_its_texture_beside_it(run, tmp_path, monkeypatch):
    monkeypatch.setattr(texture, "FACES", 600)
    path = tmp_path / "a b.obj"  # other programs end a name at a space
    line = export_run(run, "textured", path)
    export_run(run, "textured", tmp_path / "a.glb")
    assert line.endswith("with its .mtl and .png")
    assert {file.name for file in tmp_path.iterdir()} == {"a b.obj", "a_b.mtl", "a_b.png", "a.glb"}
    assert {"mtllib a_b.mtl", "usemtl a_b"} < {*path.read_text().splitlines()}
    obj, glb_mesh = (trimesh.load(tmp_path / name, force="mesh") for name in ("a b.obj", "a.glb"))
    assert obj.triangles == pytest.approx(glb_mesh.triangles, abs=1e-5)
    uv = [mesh.visual.uv[mesh.faces] for mesh in (obj, glb_mesh)]
    assert uv[0] == pytest.approx(uv[1], abs=1e-5)
    images = obj.visual.material.image, glb_mesh.visual.material.baseColorTexture
    assert np.array_equal(*(np.asarray(image.convert("RGB")) for image in images))
    first = path.read_text().splitlines()[0]
    assert first.startswith("# seen_faces ") and "shown by no photograph" in first
    assert check_target("textured", run.folder.path, path) == path
    materials, _ = companions(path)
    before = materials.read_text()
    materials.write_text("newmtl mine\n")
    with pytest.raises(UserError, match=r"a_b\.(mtl|png): pp-cl did not write this"):
        check_target("textured", run.folder.path, path)
    materials.write_text(before)
    path.unlink()  # its companions may be a user's now
    with pytest.raises(UserError, match=r"a_b\.(mtl|png): pp-cl did not write this"):
        check_target("textured", run.folder.path, path)
    for file in companions(path):
        file.unlink()
    assert check_target("textured", run.folder.path, path) == path


def test_highlights_are_left_out(rng):
    """Four of ten views show a highlight instead of the colour."""
    colours = np.array([0.4, 0.3, 0.2]) + 0.02 * rng.normal(size=(50, 10, 3))
    colours[:, ::3] = 0.95
    weights = rng.uniform(0.8, 1, (50, 10))
    weights[40:] = 0
    means = agreed(weights, colours)
    assert np.abs(means[:40] - (0.4, 0.3, 0.2)).max() < 0.04 and not means[40:].any()
    first_weights = np.zeros((50, 10))
    first_weights[:, 0] = 1e-3
    assert agreed(first_weights, colours) == pytest.approx(0.95)
