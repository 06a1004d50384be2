"""Damaged and odd input on all that pp-cl reads is taken and sound, or refused in one line.

A few examples of each surface here; `make fuzz` tries as many as it is told, other ones each time.
"""

import argparse
import importlib
import json
import math
import os
import re

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

if not hasattr(os, "fork"):
    pytest.skip("needs Unix", allow_module_level=True)

from support import damage
from support.checkpoints import load_checkpoint
from support.damage import one, rarely
from support.fuzz_world import (
    FORMATS,
    SIDE,
    ball_views,
    check_finite,
    check_written,
    command,
    opened_world,
    set_words,
    strict_json,
    taken,
)
from support.sparse import write_model, write_ply, write_some_edits

from pp_cl.checkpoint import load_run_state
from pp_cl.commands import COMMANDS
from pp_cl.config import load_config, run_config
from pp_cl.engine.grid import Grid
from pp_cl.files.exr import write_exr
from pp_cl.files.image import image_size, read_mask, read_rgba
from pp_cl.files.run_folder import Log, RunFolder
from pp_cl.metrics.shape import overlap, read_mesh, sample_surface
from pp_cl.scene.edits import read_edits
from pp_cl.scene.hull import build_grid, depth_range, spacing_pixels
from pp_cl.scene.load import load_scene, scene_splits
from pp_cl.scene.masks import cut_out, read_mask_of_size
from pp_cl.scene.readers.camera_file import read_cameras
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.scene.sparse import sparse_points
from pp_cl.settings import Config, every_setting
from pp_studio.sweep.plan import Job
from pp_studio.sweep.result import finished_row

MOST_MEMORY = 2**26  # bytes of pixels that a small file may unfold to without a word
KEYS = [key for key, _, _ in every_setting(Config())]
keys = st.sampled_from(KEYS) | damage.words
# what makes a command end soon, whatever else it is told; others are refused in any case
ENDING = {
    "render": ["--seconds", "0.1", "--fps", "10"],
    "train": set_words(train__iterations=1),
    "sweep": ["--dry-run"],
    "bench": ["--points", "100", "--size", "16"],
    **{name: ["--no-such"] for name in ("view", "selftest")},
}


@pytest.fixture(scope="module")
def world(tmp_path_factory, session_device):
    with opened_world(tmp_path_factory.mktemp("fuzz"), session_device) as world:
        yield world


def fuzzed(share=1.0):
    """A share of the examples of a surface: a tenth of the profile's, for files take long."""
    return settings(max_examples=max(1, round(share * settings.default.max_examples / 10)))


def train(folder, scene):
    """Two steps on a scene, and an evaluation; what they leave must be sound."""
    out, words = folder / "out", set_words(train__iterations=2)
    if command("train", scene, "--out", out, *words) == 0:
        check_written(out)
        if command("eval", out, "--split", "train") == 0:
            check_written(out)


def check_camera(camera):
    rotation = camera.pose[:, :3]
    assert camera.pose.shape == (3, 4)
    check_finite(pose=camera.pose, lens=(camera.fx, camera.fy, camera.cx, camera.cy))
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) > 0 and min(camera.fx, camera.fy) > 0
    assert all(isinstance(n, int) and n > 0 for n in (camera.width, camera.height))


def read_scene(folder):
    assert all(isinstance(split, str) for split in scene_splits(folder))
    return load_scene(folder, ("train", "test"))


def carve(device, views):
    views = [view.reduced(1) for view in views]
    hull, cameras = build_grid(device, views, 300), [view.camera for view in views]
    near, far = depth_range(views, hull)
    assert 0 <= near < far < math.inf and np.float32(near) < np.float32(far)
    assert (
        0 < spacing_pixels(hull.grid, cameras) < math.inf and np.float32(hull.grid.voxel_size) > 0
    )
    check_finite(grid=hull.grid.packed(hull.grid.centre))
    check_finite(camera=cameras[0].packed((near, far), hull.grid.centre))
    return hull


@pytest.mark.parametrize("name", FORMATS)
@fuzzed(0.5)
@given(data=st.data())
def test_a_scene(world, name, data):
    with world.watched() as folder:
        scene = world.scene(name, folder)
        files = sorted(path for path in (folder / "scene").rglob("*") if path.is_file())
        cameras = [file for file in files if file.suffix not in (".png", ".jpg")]
        damage.damage_file(data.draw, one(data.draw, *cameras * 4, *files))
        read = taken(lambda: read_scene(scene))
        if read is None:
            return
        views = read.splits["train"]
        for view in (*views, *read.splits["test"]):
            check_camera(view.stored_camera)
            size = view.stored_camera.height, view.stored_camera.width, 4
            assert view.image.shape == size and view.image.dtype == np.uint8
            assert view.depth_range is None or 0 < view.depth_range[0] < view.depth_range[1] < 1e300
        if taken(lambda: carve(world.device, views)) and rarely(data.draw, 30):
            train(folder, scene)


@fuzzed()
@given(data=st.data())
def test_sparse_points_and_edits(world, data):
    kind = one(data.draw, "ply", "binary", "text")
    with world.watched() as folder:
        write_some_edits(folder)
        if kind == "ply":
            write_ply(folder)
        else:
            write_model(folder / "sparse" / "0", binary=kind == "binary")
        files = sorted(path for path in folder.rglob("*") if path.stat().st_size)
        damage.damage_file(data.draw, one(data.draw, *(path for path in files if path.is_file())))
        edits = taken(lambda: read_edits(folder))
        assert edits is None or edits.box is None or (edits.box[0] < edits.box[1]).all()
        if read := taken(lambda: sparse_points(folder)):
            points, colours = read
            check_finite(points=points)
            assert points.shape == colours.shape == (len(points), 3) and colours.dtype == np.uint8


def drawn_image(draw, folder):
    """(a new image file of some kind, its RGBA where the kind keeps it without loss)."""
    width, height = one(draw, (8, 8), (1, 1), (13, 7))
    noise = np.random.default_rng(draw(st.integers(0, 9))).integers(0, 256, (height, width, 4))
    kind = one(draw, "PNG", "PNG", "PNG", "JPEG", "WEBP", "EXR", "EXR")
    file = folder / f"image.{kind.lower()}"
    if kind == "EXR":
        names = one(draw, "RGBA", "RGB", "Y", "YA", "Z", ("left.R", "left.G", "left.B", "A"))
        values = (noise[..., 0] + 1) / 256 * one(draw, 1, 1, 1e4, -1, math.nan, math.inf)
        values = values.astype(one(draw, np.float32, np.float16))
        write_exr(file, dict.fromkeys(names, values))
        return file, None
    modes = {"PNG": ["RGBA", "RGB", "L", "LA", "P", "1", "I;16"], "JPEG": ["RGB", "L", "CMYK"]}
    mode = one(draw, *modes.get(kind, ["RGBA", "RGB"]))
    image = Image.fromarray(noise.astype(np.uint8))
    image = image.convert("L").convert(mode) if mode == "I;16" else image.convert(mode)
    frames = [image.copy()] if kind != "JPEG" and rarely(draw) else []
    image.save(file, kind, **{"save_all": True, "append_images": frames} if frames else {})
    exact = kind == "PNG" and mode != "I;16" and not frames
    return file, np.array(image.convert("RGBA")) if exact else None


@fuzzed(4)
@given(data=st.data())
def test_an_image(world, data):
    """Other pixels than its own are nothing to go on with."""
    with world.watched() as folder:
        file, pixels = drawn_image(data.draw, folder)
        how, whole = one(data.draw, "bytes", "bytes", "chunks", "whole"), file.read_bytes()
        if how == "chunks" and file.suffix == ".png":
            file.write_bytes(damage.damaged_png(data.draw, whole))
            pixels = None
        elif how == "bytes":
            file.write_bytes(damage.damaged_bytes(data.draw, whole))
        size = taken(lambda: image_size(file))
        rgba, mask = (taken(lambda read=read: read(file)) for read in (read_rgba, read_mask))
        if how == "whole" and pixels is not None:
            assert rgba is not None
        if rgba is None:
            return
        assert size and rgba.shape == (size[1], size[0], 4) and rgba.dtype == np.uint8
        assert mask is None or (mask.shape == rgba.shape[:2] and mask.dtype == np.uint8)
        assert rgba.nbytes < MOST_MEMORY or file.stat().st_size * 2000 > rgba.nbytes
        if pixels is not None and file.read_bytes().startswith(whole[:8]):  # with its checksums
            assert np.array_equal(rgba, pixels)


@fuzzed()
@given(data=st.data())
def test_a_mask(world, data):
    """Of a file, and by colour, of an image with or without an object."""
    draw = data.draw
    with world.watched() as folder:
        image, file = ball_views()["train"][0].image, folder / "a.png"
        Image.fromarray(image[..., 3]).save(file)
        if draw(st.booleans()):
            damage.damage_file(draw, file)
        if draw(st.booleans()):
            image = np.random.default_rng(0).integers(0, 256, image.shape).astype(np.uint8)
        tolerance = one(draw, 10.0, 1e-6, 1.0, 100.0)
        name = f"{draw(damage.words)}.png" if draw(st.booleans()) else "images/a.png"
        made = taken(lambda: read_mask_of_size(file, image.shape[1::-1]))
        assert made is None or (made.shape == image.shape[:2] and made.dtype == np.uint8)
        made = taken(lambda: cut_out(image, name, tolerance))
        assert made is None or (made.shape == image.shape and made.dtype == np.uint8)


@fuzzed()
@given(data=st.data())
def test_a_path_of_cameras(world, data):
    """In each of the three forms that pp-cl render reads."""
    cameras = [view.stored_camera for view in ball_views()["train"]]
    poses = [camera.pose for camera in cameras]
    lens = {"fx": 20, "fy": 21, "width": SIDE, "height": SIDE}
    matrices = [np.vstack([pose, [0, 0, 0, 1]]).ravel().tolist() for pose in poses]
    forms = {
        "frames": {"frames": [frame_keys(camera) for camera in cameras]},
        "path": {
            "camera_path": [{"camera_to_world": matrix, "fov": 40} for matrix in matrices],
            "render_width": 20, "render_height": 16, "fps": 24,
        },
        "splatting": [
            {"id": i, "rotation": pose[:, :3].tolist(), "position": pose[:, 3].tolist(), **lens}
            for i, pose in enumerate(poses)
        ],
    }  # fmt: skip
    with world.watched() as folder:
        file = folder / "cameras.json"
        file.write_text(json.dumps(forms[one(data.draw, *forms)]))
        damage.damage_file(data.draw, file)
        for camera in taken(lambda: read_cameras(file, one(data.draw, None, (16, 16)))) or ():
            check_camera(camera)


# --------------------------------------------------------------------------------------------------


@fuzzed(4)
@given(data=st.data())
def test_a_checkpoint(world, data):
    """What is believed of it is evaluated, or trained on, now and then."""
    draw = data.draw
    with world.watched() as folder:
        run = world.run(folder, finished=draw(st.booleans()))
        config = load_config(run.config)
        if draw(st.booleans()):
            header, arrays = load_checkpoint(run.checkpoint)
            text = np.frombuffer(damage.damaged_json(draw, header), np.uint8)
            members = [(f"{k}.npy", damage.npy(v)) for k, v in {"header": text, **arrays}.items()]
            run.checkpoint.write_bytes(damage.archived(members))
        else:
            damage.damage_file(draw, run.checkpoint)
        state = taken(lambda: load_run_state(run, config))
        if state is None:
            return
        check_state(*state)
        again = ["train", world.scene(), "--out", run, *set_words()]
        if rarely(draw, 4) and command(*one(draw, ["eval", run], again)) == 0:
            check_written(run.path)


def check_state(header, arrays):
    ids, grid = arrays["points.ids"].astype(np.int64), Grid.of_header(header["grid"])
    assert (np.diff(ids) > 0).all() and (grid.coordinates(ids) < grid.dims).all()
    assert len(ids) == len(arrays["points.opacity"]) > 0
    near, far = header["depth_range"]
    assert 0 <= near < far < math.inf and 0 < header["grid"]["voxel_size"] < math.inf
    check_finite(**arrays)


def tell(run):
    """What `pp-cl info` says of a run, without NaN."""
    if command("info", run, "--json", "facts.json") == 0:
        strict_json(run.path.parent / "facts.json")


def check_config(config):
    """Settings are of their types and within their limits."""
    for key, section, item in every_setting(config):
        value, limits = getattr(section, item.name), item.metadata
        several = isinstance(item.default, tuple)
        assert type(value) is type(item.default), key
        assert not several or len(value) == len(item.default), key
        for part in value if several else (value,):
            check_finite(**{key: part})
            assert limits["least"] is None or limits["least"] <= part <= limits["most"], key
        assert not limits["choices"] or value in limits["choices"], key


@fuzzed(3)
@given(data=st.data())
def test_a_config(world, data):
    with world.watched() as folder:
        run = world.run(folder)
        damage.damage_file(data.draw, run.config)
        config = taken(lambda: load_config(run.config))
        if config is not None:
            check_config(config)
            tell(run)


def job(world, run):
    """The run as one of a sweep."""
    given = tuple((*word.split("=", 1), "--set") for word in set_words()[1::2])
    paths = str(world.scene()), "ball", {}, 0, str(run.path)
    return Job(*paths, "tiny", given, ("psnr", "ssim"))


@fuzzed(2)
@given(data=st.data())
def test_a_log(world, data):
    """Read by a training that goes on, by info, view and sweep."""
    with world.watched() as folder:
        run = world.run(folder, finished=data.draw(st.booleans()))
        damage.damage_file(data.draw, run.log)
        for row in taken(run.rows) or ():
            check_finite(step=row["step"], seconds=row["seconds"])
        taken(lambda: finished_row(job(world, run)))
        tell(run)
        log = taken(lambda: Log(run.log, one(data.draw, 0, 2, 4)))
        if log is not None:
            with log:
                assert 0 <= log.seconds < math.inf
            strict_json(run.log)


# --------------------------------------------------------------------------------------------------


@fuzzed(2)
@given(data=st.data())
def test_a_mesh(world, data):
    draw, grid = data.draw, Grid((-1.0, -1.0, -1.0), 0.25, (9, 9, 9))
    kind = one(draw, "ply", "obj", "stl", "off", "glb", "txt", "xyz", "3mf", "dae", "zip")
    form = kind if kind in ("obj", "stl", "off", "glb") else "ply"
    ascii_too = {"encoding": "ascii"} if form == "ply" and draw(st.booleans()) else {}
    with world.watched() as folder:
        file = folder / f"ball.{kind}"
        whole = trimesh.creation.icosphere(subdivisions=1).export(file_type=form, **ascii_too)
        file.write_bytes(whole.encode() if isinstance(whole, str) else whole)
        damage.damage_file(draw, file)
        mesh = taken(lambda: read_mesh(file))
        if mesh is None:
            return
        check_finite(vertices=mesh.vertices)
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
        surface = taken(lambda: sample_surface(world.device, mesh, grid, 2000))
        if surface is not None:
            found = overlap(surface, grid, np.arange(9**3))
            assert 0 < surface.count <= 2000
            assert found.pop("points") == 9**3
            assert all(0 <= share <= 1 for share in found.values())


@fuzzed(2)
@given(st.lists(st.tuples(keys, damage.words), min_size=1, max_size=3), st.integers(0, 9))
def test_settings(world, pairs, what):
    """--set of any keys; what is believed is trained with, now and then."""
    with world.watched() as folder:
        run, scene = RunFolder(folder / "out"), str(world.scene())
        given = [(*pair, "--set") for pair in pairs]
        config = taken(lambda: run_config(run, scene, None, given))
        if config is None:
            return
        check_config(config)
        if config.points.count < 10**4 and max(config.network.widths) < 64 and what > 8:
            words = [word for key, text in pairs for word in ("--set", f"{key}={text}")]
            words += set_words(train__iterations=2)
            if command("train", scene, "--out", run, *words) == 0:
                check_written(run.path)


@fuzzed()
@given(data=st.data())
def test_a_command_line(world, data):
    draw, name = data.draw, one(data.draw, *COMMANDS)
    parser = argparse.ArgumentParser()
    importlib.import_module(COMMANDS[name]).add_arguments(parser)
    options = st.sampled_from(re.findall(r"--[\w-]+", parser.format_help())) | damage.words
    with world.watched() as folder:
        words = [world.run(folder)]
        if name in ("train", "sweep", "capture"):
            words = [world.scene(), "--out", folder / "out"]
        elif name == "compare":
            images = [world.scene() / "train"] * 2
            words = one(draw, images, [*words, "--samples", "100"])
        elif name in ("devices", "bench", "selftest"):
            words = ["raster"] if name == "bench" else []
        if rarely(draw, 5):
            words = [draw(damage.words)]
        for option in draw(st.lists(options, max_size=2)):
            words += [option] if rarely(draw) else [option, draw(damage.words)]
        command(draw(damage.words) if rarely(draw, 20) else name, *words, *ENDING.get(name, ()))
