"""Damaged and odd input to any reader of pp-cl is accepted with sound values, or refused in one
line.

A few examples for each reader are tried here; `make fuzz` tries a given number of new ones.
"""

import argparse
import contextlib
import functools
import importlib
import json
import math
import os
import re
import shutil
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

if not hasattr(os, "fork"):
    pytest.skip("needs Unix", allow_module_level=True)

import resource

from support import damage, runs
from support.checkpoints import load_checkpoint
from support.damage import one, rarely
from support.scenes import ball_image, ring_cameras
from support.sparse import write_model, write_ply, write_some_edits

from pp_cl.checkpoint import load_run_state
from pp_cl.commands import COMMANDS
from pp_cl.config import load_config
from pp_cl.engine.grid import Grid
from pp_cl.engine.step import Trainer
from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.files.exr import write_exr
from pp_cl.files.image import image_size, read_mask, read_rgba
from pp_cl.files.run_folder import Log, RunFolder
from pp_cl.metrics.shape import overlap, read_mesh, sample_surface
from pp_cl.scene.edits import read_edits
from pp_cl.scene.hull import build_grid, depth_range, spacing_pixels
from pp_cl.scene.listing import scene_splits
from pp_cl.scene.load import load_scene
from pp_cl.scene.readers.camera_file import read_cameras
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.scene.sparse import sparse_points
from tools.convert_scene import dealt

LONGEST = 60  # seconds for an input
MEMORY = 6 * 2**30  # bytes of addresses beyond those when the module begins; PoCL takes some
MOST_PIXELS = 2**26  # bytes of pixels to which a small file may unfold without a warning
MOST_MESSAGE = 1500  # characters of a refusal: two paths and a reason
SIDE = 16
# {name: (module of tools/scene_formats, arguments of its write(), where the scene lies in its
# folder)}
FORMATS = {
    **{name: (name, {}, "") for name in ("nerf_synthetic", "nerfstudio", "neus", "nsvf", "llff")},
    "colmap": ("colmap", {"binary": True}, ""),
    "colmap text": ("colmap", {"binary": False}, ""),
    "co3d": ("co3d", {"version": 2}, "object/sequence"),
    "co3d 1": ("co3d", {"version": 1}, "object/sequence"),
}
SETTINGS = {
    "train.iterations": 4,
    "points.count": 300,
    "network.widths": "16,16,16",
    "train.crop": 12,
    "train.prune_weight": 0.0,
    "train.checkpoint_every": 2,
    "train.log_every": 1,
    "scene.downscale": 1,
}
# --set options of a training that takes a moment
set_words = functools.partial(runs.set_words, SETTINGS)
# options that end a command soon, whatever its other ones; commands not listed are refused anyway
ENDING = {
    "render": ["--seconds", "0.1", "--fps", "10"],
    "train": set_words(train__iterations=1),
    "sweep": ["--dry-run"],
    "bench": ["--points", "100", "--size", "16"],
    **{name: ["--no-such"] for name in ("view", "selftest")},
}


class Hang(BaseException):
    """An input took too long. It is no Exception, as readers turn those into messages."""


def hang(*_):
    raise Hang


def ball_views():
    """The splits of a ball at the origin, seen from a ring of cameras."""
    cameras = enumerate(ring_cameras(5, SIDE))
    return dealt(
        {"train": [View(f"r_{i}.png", camera, ball_image(camera)) for i, camera in cameras]}
    )


class World:
    """Templates of scenes and runs in a folder, and the device of all runs."""

    def __init__(self, folder, device):
        self._folder, self.device = folder, device

    def scene(self, name="nerf_synthetic", folder=None):
        """The scene in the format `name`, or a copy of it in `folder`."""
        module, options, place = FORMATS[name]
        files = self._folder / name
        if not files.exists():
            files.mkdir()
            module = importlib.import_module(f"tools.scene_formats.{module}")
            module.write(files, ball_views(), **options)
        return (shutil.copytree(files, folder / "scene") if folder else files) / place

    def train(self):
        words = ["train", self.scene(), *set_words(), "--out"]
        finished = self._folder / "finished"
        assert command(*words, finished) == command("eval", finished) == 0
        train_step = Trainer.train_step

        def stopping(trainer):
            if trainer.step == 3:
                raise KeyboardInterrupt
            return train_step(trainer)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Trainer, "train_step", stopping)
            assert command(*words, self._folder / "unfinished") == 130

    def run(self, folder, *, finished=True):
        template = self._folder / ("finished" if finished else "unfinished")
        return RunFolder(shutil.copytree(template, folder / "run"))

    @contextlib.contextmanager
    def watched(self):
        """Yields an empty folder as the working directory; fails if the block hangs, or warns by
        any warning other than pp-cl's own.
        """
        folder = self._folder / "input"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        signal.alarm(LONGEST)
        try:
            with (
                pytest.MonkeyPatch.context() as patch,
                warnings.catch_warnings(record=True) as caught,
            ):
                patch.chdir(folder)
                warnings.simplefilter("always", append=True)  # intended filters keep precedence
                warnings.filterwarnings("ignore", module=r"PIL\.")  # as in pp_cl/files/image.py
                yield folder
        finally:
            signal.alarm(0)
        for warning in caught:
            assert warning.category is UserWarning and re.search("pp_cl|fuzz", warning.filename), (
                warning
            )
            check_line(str(warning.message))


@pytest.fixture(scope="module")
def world(tmp_path_factory, session_device):
    folder = tmp_path_factory.mktemp("fuzz")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGALRM, hang)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PP_CACHE", str(folder))
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
        try:
            world = World(folder, session_device)
            world.train()  # also builds the kernels, so that no input waits for them
            yield world
        finally:
            resource.setrlimit(resource.RLIMIT_AS, limits)
            signal.signal(signal.SIGALRM, handler)


def taken(function):
    try:
        return function()
    except UserError as error:
        check_line(str(error))
    except OSError:  # the command line makes a message of it
        pass
    return None


def command(*words):
    status, lines = runs.spoken(words)
    assert status in (0, 2, 130), lines[-1:]
    if status == 2:
        assert lines and lines[-1].startswith(("pp-cl: ", "pp-cl ")), lines[-1:]
        assert "no memory left" not in lines[-1]
        check_line(lines[-1])
    return status


def check_line(message):
    assert message.isprintable() and len(message) <= MOST_MESSAGE, message[:200]


def check_finite(**named):
    for name, values in named.items():
        numbers = np.asarray(values)
        assert numbers.dtype.kind not in "fc" or np.isfinite(numbers).all(), (name, values)


def strict_json(file):
    def refuse(name):
        raise AssertionError(f"{name} written to {file.name}")

    texts = file.read_text("utf-8")
    texts = texts.splitlines() if file.suffix == ".jsonl" else [texts]
    return [json.loads(text, parse_constant=refuse) for text in texts]


def check_written(folder):
    check_finite(**load_checkpoint(folder / "checkpoint.npz")[1])
    strict_json(folder / "log.jsonl")
    for file in folder.rglob("metrics.json"):
        mean = strict_json(file)[0]["mean"]
        check_finite(**mean)
        assert -1 <= mean["ssim"] <= 1 and -10 <= mean["psnr"] <= 100, mean
    assert not list(folder.rglob(".*.tmp*"))


def fuzzed(share=1.0):
    """Settings for `share` of the usual examples: a tenth of the profile's, as files take long."""
    return settings(max_examples=max(1, round(share * settings.default.max_examples / 10)))


def train(folder, scene):
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
    """(A new image file of some kind, its RGBA or None if the kind loses something)."""
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
        assert rgba.nbytes < MOST_PIXELS or file.stat().st_size * 2000 > rgba.nbytes
        if pixels is not None and file.read_bytes().startswith(whole[:8]):  # PNG has checksums
            assert np.array_equal(rgba, pixels)


@fuzzed()
@given(data=st.data())
def test_a_path_of_cameras(world, data):
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


@fuzzed(4)
@given(data=st.data())
def test_a_checkpoint(world, data):
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
    if command("info", run, "--json", "facts.json") == 0:
        strict_json(run.path.parent / "facts.json")


@fuzzed(3)
@given(data=st.data())
def test_a_config(world, data):
    with world.watched() as folder:
        run = world.run(folder)
        damage.damage_file(data.draw, one(data.draw, run.config, run.config, run.metrics("test")))
        config = taken(lambda: load_config(run.config))
        if config is not None:
            tell(run)


@fuzzed(2)
@given(data=st.data())
def test_a_log(world, data):
    with world.watched() as folder:
        run = world.run(folder, finished=data.draw(st.booleans()))
        damage.damage_file(data.draw, run.log)
        for row in taken(run.rows) or ():
            check_finite(step=row["step"], seconds=row["seconds"])
        tell(run)
        log = taken(lambda: Log(run.log, one(data.draw, 0, 2, 4)))
        if log is not None:
            with log:
                assert 0 <= log.seconds < math.inf
            strict_json(run.log)


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
            scores = overlap(surface, grid, np.arange(9**3))
            assert 0 < surface.count <= 2000
            assert scores.pop("points") == 9**3
            assert all(0 <= share <= 1 for share in scores.values())


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
