from dataclasses import replace
from unittest.mock import Mock

import gsply
import numpy as np
import plyfile
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.gltf import glb
from support.splats import colours, draw_splats, read_splats

from pp_cl.engine import FirstFeatures, Model, Renderer, Specular
from pp_cl.engine.raster.footprint import MOST_OF_GAUSSIANS
from pp_cl.files.image import to_8bit
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.scene.gaze import up_of
from pp_studio.export import QUALITIES, QUICK, gaussians
from pp_studio.export.gaussians import (
    CONSTANT,
    DEVIATION,
    WindowCrops,
    begun,
    drawn_by,
    fit_gaussians,
    fitted_gaussians,
    window_camera,
)
from pp_studio.export.harmonics import fit_harmonics
from pp_studio.export.splat import (
    Y_DOWN,
    Y_UP,
    in_spz,
    splats,
    upright,
    write_splat_glb,
    write_splat_ply,
    write_splat_spz,
)
from tools.splat_quality import beside_hull

# the layout of 3D Gaussian splatting's training code at degree 3
LAYOUT = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
LAYOUT += [*(f"f_rest_{i}" for i in range(45)), "opacity", *(f"scale_{i}" for i in range(3))]
LAYOUT += [f"rot_{i}" for i in range(4)]


@pytest.fixture(scope="module", autouse=True)
def steps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(QUALITIES, QUICK, (400, 0.0))
        yield


@pytest.fixture(scope="module")
def y_up(run, steps):
    return splats(run, upright(run, Y_UP))


@pytest.fixture(scope="module")
def ply(run, steps, tmp_path_factory):
    path = tmp_path_factory.mktemp("splat") / "a.ply"
    write_splat_ply(path, splats(run, upright(run, Y_DOWN))[0])
    return path


def turned(run, camera):
    up = up_of(run.cameras("train"))
    turn = Rotation.align_vectors([(0, -1, 0)], [up])[0].as_matrix()
    return replace(camera, pose=turn @ camera.pose)


def test_the_header_is_that_of_the_training_code(ply):
    header = ply.read_bytes().partition(b"end_header\n")[0].decode().splitlines()
    count = len(plyfile.PlyData.read(str(ply))["vertex"])
    assert header == [
        "ply",
        "format binary_little_endian 1.0",
        "comment Vertical axis: y",
        f"element vertex {count}",
        *(f"property float {name}" for name in LAYOUT),
    ]


def test_what_is_no_colour(run, ply):
    vertex, ply_splats = plyfile.PlyData.read(str(ply))["vertex"], read_splats(ply)
    up, grid = up_of(run.cameras("train")), run.model.grid
    turn = Rotation.align_vectors([(0, -1, 0)], [up])[0].as_matrix()
    vertices = grid.positions(run.model.cloud.ids.get())
    apart = cKDTree(vertices).query(ply_splats["positions"] @ turn, p=np.inf)[0]
    assert apart.max() < (MOST_OF_GAUSSIANS + 1e-4) * grid.voxel_size
    assert 0.3 * len(vertices) < len(apart) <= len(vertices)
    assert turn @ up == pytest.approx([0, -1, 0])
    assert ply_splats["opacity"].min() > 1 / 255 and ply_splats["opacity"].max() < 0.991
    size = np.linalg.eigvalsh(ply_splats["covariance"]) ** 0.5
    size /= DEVIATION * run.config.raster.radius * grid.voxel_size
    assert size.min() > 0.02 and size.max() < 2 * np.exp(MOST_OF_GAUSSIANS)
    assert np.median(size[:, 2] / size[:, 0]) > 1.1  # most are no longer balls
    assert all((vertex[f"n{axis}"] == 0).all() for axis in "xyz")


def likeness(run, path, scale):
    """Mean PSNR of test views that are drawn `scale` times as large and averaged."""
    ply_splats, measured = read_splats(path), []
    for camera in run.cameras("test"):
        large = turned(run, camera.resized(scale * camera.width, scale * camera.height))
        blocks = draw_splats(ply_splats, large).reshape(
            camera.height, scale, camera.width, scale, 3
        )
        measured.append(psnr(to_8bit(blocks.mean((1, 3))), to_8bit(run.render(camera).colour)))
    return np.mean(measured)


def test_the_engine_draws_them_as_viewers_do(run, ply):
    ply_splats, kept = read_splats(ply), fitted_gaussians(run)._replace(specular=None)
    least, most = kept.windows
    drawn = drawn_by(run, kept)
    for scale in (least, 3, most):
        camera = run.cameras("test")[0]
        camera = camera.resized(round(scale * camera.width), round(scale * camera.height))
        view = drawn.render(window_camera(camera, scale, kept))
        viewers = draw_splats(ply_splats, turned(run, camera))
        assert psnr(to_8bit(view.colour), to_8bit(viewers)) > 50
        np.testing.assert_array_equal(view.alpha == 0, np.isinf(view.depth))
    small = run.cameras("test")[0]  # viewers would draw them too wide here
    as_is = drawn.render(small).colour
    mended = drawn.render(window_camera(small, 1.0, kept)).colour
    wanted = to_8bit(run.render(small).colour)
    assert psnr(to_8bit(mended), wanted) > psnr(to_8bit(as_is), wanted) + 1


def test_gaussians_look_like_the_run_in_windows_of_any_size(run, ply):
    assert min(likeness(run, ply, scale) for scale in (2, 3, 5)) > 34


def test_points_of_a_cell_begin_as_one_that_looks_like_them(run):
    coefficients = fit_harmonics(run, steps=1)
    places = run.model.positions()
    for cell in (0.0, 1.5):
        cloud = begun(run, coefficients, cell)
        ids, offset = cloud.ids.get(), cloud.offset.get()
        assert (np.diff(ids.astype(np.int64)) > 0).all()
        positions = run.model.grid.positions(ids) + run.model.grid.voxel_size * offset[:, :3]
        away = cKDTree(places).query(positions, p=np.inf)[0] / run.model.grid.voxel_size
        assert away.max() < 1e-4 if cell == 0 else cloud.count < 0.7 * len(places)
        assert away.max() <= cell
    most = cloud.count // 2
    assert 0.7 * most < begun(run, coefficients, cell, most).count <= most
    # merging points of one colour in a cell keeps that colour
    sh = cloud.sh[0].get()[:, 0, :3] * CONSTANT
    assert coefficients[:, 0].min() - 1e-5 < sh.min() and sh.max() < coefficients[:, 0].max() + 1e-5


@pytest.mark.parametrize(("size", "least", "most"), [(30, 2, 8), (400, 1.5, 6), (1600, 1, 4)])
def test_windows_are_as_large_as_people_have_them(run, size, least, most):
    (view, *_) = run.rendered(run.image_files("train")[:1], opaque=True)
    large = replace(view, stored_camera=view.stored_camera.resized(size, size))
    crops = WindowCrops(
        [replace(large, image=np.zeros((size, size, 4), np.uint8))], run.config.train, 0
    )
    drawn = [crops.draw(step).camera.samples for step in range(200)]
    assert least <= min(drawn) < 1.1 * least and 0.9 * most < max(drawn) <= most


def test_they_are_fitted_to_alpha(run, monkeypatch):
    trainer = Mock(side_effect=InterruptedError)
    monkeypatch.setattr(gaussians, "Trainer", trainer)
    with pytest.raises(InterruptedError):
        fit_gaussians(run, 10, 0.0)
    _, config, _, views = trainer.call_args.args
    assert config.train.mask_weight > 0
    assert len(views) == 2 * len(run.cameras("train")) and all(view.has_mask for view in views)


def test_they_are_fitted_once_for_a_checkpoint(run, monkeypatch):
    table, origin, *_, specular, _ = fitted_gaussians(run)
    monkeypatch.setattr(gaussians, "Trainer", Mock(side_effect=InterruptedError))
    again, *_, layer, _ = fitted_gaussians(run)
    assert np.array_equal(table, again)
    assert all(np.array_equal(specular[name], layer[name]) for name in Specular.shapes())
    positions = table["position"] + origin
    assert cKDTree(run.model.positions()).query(positions)[0].max() < 4 * run.model.grid.voxel_size
    path = run.folder.path / "gaussians.npz"
    whole = path.read_bytes()
    for changed in (whole[:1000], b"", b"no archive"):
        path.write_bytes(changed)
        with pytest.raises(InterruptedError):
            fitted_gaussians(run)
    path.write_bytes(whole)
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **(arrays | {"specular.a.bias": np.zeros(3, np.float32)}))
    with pytest.raises(InterruptedError):
        fitted_gaussians(run)
    path.write_bytes(whole)
    with np.load(path) as stored:
        arrays = dict(stored)
    limited = gaussians._keys(run)[QUICK, True]  # as `make` keeps what it fitted in its minutes
    np.savez(path, **(arrays | {"key": np.array(limited)}))
    assert np.array_equal(fitted_gaussians(run)[0], table)
    with pytest.raises(InterruptedError):
        fitted_gaussians(run, QUICK)
    path.write_bytes(whole)
    monkeypatch.setitem(QUALITIES, QUICK, (401, 0.0))
    with pytest.raises(InterruptedError):
        fitted_gaussians(run)


def test_a_specular_layer_adds_what_they_lack(run):
    """Here a part of their colours, in views that it was not fitted to."""
    fitted = fitted_gaussians(run)._replace(specular=None)
    fitted.table["harmonics"][:, 0, :2] -= 0.4
    mended = fitted._replace(specular=gaussians._fit_specular(run, fitted))
    measured = []
    for each in (fitted, mended):
        drawn, values = drawn_by(run, each), []
        for camera in run.cameras("test"):
            shown = drawn.render(window_camera(camera, 1.0, each)).colour
            values.append(psnr(to_8bit(shown), to_8bit(run.render(camera).colour)))
        measured.append(np.mean(values))
    assert measured[1] > measured[0] + 1.5


def test_they_are_fitted_to_the_images_that_the_run_learned_from(run, monkeypatch):
    monkeypatch.setattr(gaussians, "Trainer", fitted := Mock(side_effect=InterruptedError))

    def views():
        with pytest.raises(InterruptedError):
            fit_gaussians(run, 1, 0.0)
        return fitted.call_args[0][3]

    images, fit_views = run.scene("train").splits["train"], views()
    assert len(fit_views) == 2 * len(images)
    for view, other in zip(images, fit_views, strict=False):
        assert view.name == other.name and (view.image == other.image).all()
    rendered = [view.image.shape for view in run.rendered(run.image_files("train"), opaque=True)]
    assert [view.image.shape for view in fit_views[len(images) :]] == rendered
    with monkeypatch.context() as patch:  # pretend that the images are large, and enough
        patch.setattr("pp_cl.engine.views.MIN_SIDE", 8)
        patch.setattr(gaussians, "MIN_SIDE", 8)
        patch.setattr(gaussians, "LARGEST", 15)
        patch.setattr(gaussians, "ENOUGH", len(images))
        assert [(view.name, view.camera.width) for view in views()] == [
            (view.name, 15) for view in images
        ]
    monkeypatch.setitem(run.header, "left_out", [fit_views[0].name])
    assert [view.name for view in views()][:2] == [fit_views[1].name, fit_views[2].name]
    monkeypatch.setitem(run.header, "exposed", True)
    assert [view.image.shape for view in views()] == 2 * rendered
    monkeypatch.delitem(run.header, "exposed")
    monkeypatch.setattr(run.config.scene, "path", "gone")
    with pytest.warns(UserWarning, match="renderings of the training views alone: gone"):
        assert [view.image.shape for view in views()] == 2 * rendered


def test_the_spz_says_the_same_with_y_up(y_up, ply, tmp_path):
    """Errors are within the format's steps: half a deviation of a place, 1/255 of an opacity,
    exp(1/32) of a deviation, 5/128 of a harmonic.
    """
    table, _ = y_up
    write_splat_spz(tmp_path / "a.spz", table)
    spz = gsply.read_spz(tmp_path / "a.spz")
    smallest = float(table["deviations"].max(1).min())
    assert spz.means == pytest.approx(table["position"], abs=0.51 * smallest)
    assert 1 / (1 + np.exp(-spz.opacities)) == pytest.approx(table["opacity"], abs=3e-3)
    assert spz.scales == pytest.approx(np.log(table["deviations"]), abs=0.04)
    same = np.abs((spz.quats * table["turn"]).sum(1)) / np.linalg.norm(spz.quats, axis=1)
    assert same.min() > 0.999  # cosine of half an angle
    assert spz.sh0 == pytest.approx(table["harmonics"][:, 0], abs=0.02)
    rest = table["harmonics"][:, 1:].clip(-127 / 128, 127 / 128)  # the range of 8 bits
    assert np.abs(spz.shN - rest).max() < 0.0392
    assert (tmp_path / "a.spz").stat().st_size < ply.stat().st_size / 9


@pytest.mark.parametrize(("unit", "sign"), [(100, 0), (1e7, -1), (1e-6, 1), (0.1, 0)])
def test_the_spz_holds_objects_of_any_size(y_up, unit, sign, tmp_path):
    """In millimetres, too, for which the format's places have the fewest bits. Sizes far beyond its
    range are scaled.
    """
    table = y_up[0].copy()
    table["position"] *= unit
    table["deviations"] *= unit
    scaled, times = in_spz(table)
    write_splat_spz(tmp_path / "a.spz", scaled)
    spz = gsply.read_spz(tmp_path / "a.spz")
    widest = table["deviations"].max(1)
    assert np.sign(np.log10(times)) == sign
    away = np.abs(spz.means / times - table["position"]).max(1)
    assert (away < 0.6 * widest).all()
    assert np.exp(spz.scales).max(1) / times == pytest.approx(widest, rel=0.04)


def test_the_glb_says_the_same_with_y_up(y_up, ply, tmp_path, rng):
    table, origin = y_up
    write_splat_glb(tmp_path / "a.glb", table, origin)
    gltf, arrays = glb(tmp_path / "a.glb")
    (primitive,) = gltf["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and gltf["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    prefix, ply_splats = "KHR_gaussian_splatting:", read_splats(ply)
    flip = np.array([1, -1, -1])  # a half turn around x
    assert arrays["POSITION"] * flip == pytest.approx(ply_splats["positions"], abs=1e-5)
    assert gltf["accessors"][0]["max"] == pytest.approx(arrays["POSITION"].max(0))
    assert arrays[prefix + "OPACITY"][:, 0] == pytest.approx(ply_splats["opacity"], abs=1e-5)
    axes = Rotation.from_quat(arrays[prefix + "ROTATION"]).as_matrix()
    axes *= arrays[prefix + "SCALE"][:, None]
    covariance = flip[:, None] * (axes @ axes.transpose(0, 2, 1)) * flip
    assert covariance == pytest.approx(ply_splats["covariance"], abs=1e-6 * covariance.max())
    names = [(d, k) for d in range(3) for k in range(2 * d + 1)]
    harmonics = np.stack([arrays[f"{prefix}SH_DEGREE_{d}_COEF_{k}"] for d, k in names], 1)
    assert len(arrays) == 5 + 9
    towards = rng.normal(size=(len(harmonics), 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    ours, theirs = colours(harmonics, towards), colours(ply_splats["harmonics"], towards * flip)
    assert ours == pytest.approx(theirs, abs=1e-4)


def test_a_needle_beside_the_hull_is_measured(run):
    """tools/splat_quality.py measures it: its images from below and above show the whole needle."""
    cloud = begun(run, fit_harmonics(run, steps=0), 0)
    settings = gaussians.config_of(run, 1).raster

    def beside():
        model = Model(
            run.dev, run.model.grid, run.model.depth_range, cloud, net=FirstFeatures(run.dev)
        )
        return beside_hull(run, Renderer(run.dev, model, settings))

    before = beside()
    assert before < 0.05
    offset, opacity = cloud.offset.get(), cloud.opacity.get()
    highest = run.model.grid.positions(cloud.ids.get())[:, 2].argmax()
    unit = DEVIATION * run.config.raster.radius * run.model.grid.voxel_size
    offset[highest, 3:9] = [0, 0, np.log(0.5 / unit), 0, 0, 0]  # a needle upwards, half a unit long
    opacity[highest] = 0
    opacity[highest, 0] = 0.9
    cloud.offset.set(offset)
    cloud.opacity.set(opacity)
    assert beside() > 0.1
