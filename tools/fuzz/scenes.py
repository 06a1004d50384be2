"""Surfaces of scenes: the files of every format, photographs and masks, paths of cameras."""

import json
import math
from functools import partial
from pathlib import Path
from random import Random

import numpy as np
from PIL import Image

from pp_cl.files.exr import write_exr
from pp_cl.files.image import image_size, read_gray, read_rgba
from pp_cl.scene.camera import Camera
from pp_cl.scene.hull import build_grid, depth_range, spacing_pixels
from pp_cl.scene.load import find_reader, load_scene
from pp_cl.scene.masks import MaskRule
from pp_cl.scene.readers.camera_file import read_cameras
from pp_cl.scene.readers.frame import frame_keys
from tools.fuzz.binary import PNG_SIGNATURE, changed_bytes, changed_png
from tools.fuzz.files import changed_file, changed_tree
from tools.fuzz.judge import Case, check, check_numbers
from tools.fuzz.runs import check_run_files
from tools.fuzz.templates import FORMATS, SIDE, ball_views, set_words
from tools.fuzz.values import brief, odd_text

PICTURES = (".png", ".jpg", ".webp", ".exr")
MOST_MEMORY = 2**26  # bytes of pixels that a small file may unfold to without a word


def scene(name: str, case: Case) -> None:
    """A scene of a format with a changed file; read, carved, now and then trained on."""
    rng = case.rng
    folder = case.world.copied_scene(name, case.folder / "scene")
    files = sorted(path for path in (case.folder / "scene").rglob("*") if path.is_file())
    cameras = [file for file in files if file.suffix not in PICTURES]
    file = rng.choice(cameras if rng.random() < 0.85 else files)
    case.label = (changed_tree if rng.random() < 0.05 else changed_file)(rng, file)
    read = case.read(lambda: _read(folder))
    if read is None:
        return
    views = read.splits["train"]
    for view in [*views, *read.splits["test"]]:
        check_view(view)
    if case.read(partial(_carve, case.world.device, views)) and rng.random() < 0.03:
        train(case, folder)


def _read(folder):
    for split in find_reader(folder).splits(folder):
        check(isinstance(split, str), f"a split called {split!r}")
    return load_scene(folder, ("train", "test"))


def _carve(device, views):
    views = [view.reduced(1) for view in views]
    hull = build_grid(device, views, 300)
    near, far = depth_range(views, hull)
    cameras = [view.camera for view in views]
    check(0 <= near < far < math.inf, f"depth from {near} to {far}")
    check(0 < spacing_pixels(hull.grid, cameras) < math.inf, "points no pixels apart")
    packed = [hull.grid.packed(hull.grid.centre), cameras[0].packed((near, far), hull.grid.centre)]
    check(np.isfinite(np.concatenate(packed)).all(), "a hull or camera that float32 does not hold")
    check(np.float32(near) < np.float32(far) and np.float32(hull.grid.edge) > 0, "a flat hull")
    return hull


def check_view(view) -> None:
    """Raise a Finding unless a view that was read is sound."""
    check_camera(view.stored_camera)
    size = (view.stored_camera.height, view.stored_camera.width, 4)
    check(view.image.shape == size and view.image.dtype == np.uint8, f"image {view.image.shape}")
    if view.depth_range is not None:
        near, far = view.depth_range
        check(0 < near < far < math.inf, f"near {near}, far {far}")


def check_camera(camera: Camera) -> None:
    """Raise a Finding unless a camera that was read is sound."""
    rotation = camera.pose[:, :3]
    check(camera.pose.shape == (3, 4) and np.isfinite(camera.pose).all(), "a pose that is none")
    check(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6), "a rotation that is none")
    check(np.linalg.det(rotation) > 0, "a mirrored camera")
    lens = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    check_numbers(lens, "camera")
    check(min(camera.fx, camera.fy) > 0, f"focal lengths {camera.fx}, {camera.fy}")
    sides = camera.width, camera.height
    check(all(isinstance(n, int) and n > 0 for n in sides), f"a camera of {sides} pixels")


def train(case: Case, folder: Path) -> None:
    """Train two steps on a scene that can be carved, measure; files must be sound."""
    out = case.folder / "out"
    if case.command("train", folder, "--out", out, *set_words(train__iterations=2)) == 0:
        check_run_files(out)
        if case.command("eval", out, "--split", "train") == 0:
            check_run_files(out)


SURFACES = {name: partial(scene, name) for name in FORMATS}


# --------------------------------------------------------------------------------------------------


def picture(rng: Random, folder: Path) -> tuple[Path, np.ndarray | None]:
    """(a new image file of some kind, its RGBA where the kind keeps it without loss)."""
    width, height = rng.choice([(1, 1), (8, 8), (13, 7), (16, 16)])
    noise = np.frombuffer(rng.randbytes(4 * width * height), np.uint8).reshape(height, width, 4)
    kind = rng.choice(["PNG"] * 4 + ["JPEG", "WEBP", "EXR", "EXR"])
    file = folder / f"picture.{kind.lower()}"
    if kind == "EXR":
        names = rng.choice(["RGBA", "RGB", "Y", "YA", "Z", ("left.R", "left.G", "left.B", "A")])
        kinds = rng.choice([np.float32, np.float16])
        values = rng.choice([1, 1, 1, 1e4, -1, math.nan, math.inf])
        write_exr(file, {n: (noise[..., 0] / 255 * values).astype(kinds) for n in names})
        return file, None
    mode = rng.choice(["RGBA", "RGB", "L", "LA", "P", "1", "I;16", "CMYK"])
    if mode in ("I;16", "CMYK") and kind != {"I;16": "PNG", "CMYK": "JPEG"}[mode]:
        mode = "RGB"
    if kind == "JPEG" and mode not in ("L", "CMYK"):
        mode = "RGB"
    image = Image.fromarray(noise)
    image = image.convert("L").convert(mode) if mode == "I;16" else image.convert(mode)
    extra = {"lossless": rng.random() < 0.5} if kind == "WEBP" else {}
    if kind != "JPEG" and rng.random() < 0.1:
        extra |= {"save_all": True, "append_images": [image.copy()]}
    image.save(file, kind, **extra)
    exact = kind == "PNG" and mode != "I;16" and "save_all" not in extra
    return file, np.array(image.convert("RGBA")) if exact else None


def images(case: Case) -> None:
    """An image file, damaged or not: other pixels than its own are nothing to go on with."""
    rng = case.rng
    file, pixels = picture(rng, case.folder)
    data, how = file.read_bytes(), rng.choice(["whole", "bytes", "bytes", "bytes", "chunks"])
    if how == "chunks" and data.startswith(PNG_SIGNATURE):
        how, data = changed_png(rng, data)
        pixels = None
    elif how == "bytes":
        how, new = changed_bytes(rng, data)
        data, pixels = new, pixels if pixels is not None and _same_checked(data, new) else None
    file.write_bytes(data)
    case.label = f"{file.name} {how}"
    size = case.read(lambda: image_size(file))
    read = case.read(lambda: (read_rgba(file), read_gray(file)))
    if how == "whole" and pixels is not None:
        check(read is not None, "nothing: a whole image was refused")
    if read is None:
        return
    rgba, gray = read
    check(size is not None, "pixels of an image that has no size")
    check(rgba.shape == (size[1], size[0], 4) and rgba.dtype == np.uint8, f"pixels {rgba.shape}")
    check(gray.shape == rgba.shape[:2] and gray.dtype == np.uint8, f"gray pixels {gray.shape}")
    check(rgba.nbytes < MOST_MEMORY or len(data) * 2000 > rgba.nbytes, "a bomb")
    if pixels is not None:
        check(np.array_equal(rgba, pixels), "pixels that are not the file's")


def _same_checked(old, new):
    """Whether a checksum covers the place in which a damaged PNG differs: behind the signature."""
    return new.startswith(PNG_SIGNATURE) and old != new


def masks(case: Case) -> None:
    """A photograph and a mask beside it, by every rule."""
    rng, view = case.rng, ball_views()["train"][0]
    folder = case.folder / "masks"
    folder.mkdir()
    name = rng.choice(["a.png", "images/a.png", "a.jpg", f"{odd_text(rng)}.png"])
    source = rng.choice(["given", "alpha", "color", "box", "none"])
    tolerance = rng.choice([1e-6, 1.0, 10.0, 100.0])
    file = folder / "a.png"
    Image.fromarray(view.image[..., 3]).save(file)
    case.label = f"{source} {brief(name)} "
    if rng.random() < 0.7:
        case.label += (changed_tree if rng.random() < 0.2 else changed_file)(rng, file)
    image = (
        view.image
        if rng.random() < 0.5
        else np.frombuffer(rng.randbytes(SIDE * SIDE * 4), np.uint8).reshape(SIDE, SIDE, 4)
    )
    rule = MaskRule(source, str(folder) if rng.random() < 0.5 else "", tolerance)
    made = case.read(lambda: rule.apply(image, name, file))
    if made is not None:
        check(made.shape == image.shape and made.dtype == np.uint8, f"a mask {made.shape}")


def cameras(case: Case) -> None:
    """A file of cameras for pp-cl render."""
    rng, cameras = case.rng, [view.stored_camera for view in ball_views()["train"]]
    rows = [camera.pose for camera in cameras]
    kind = rng.choice(["camera_path", "transforms", "splatting"])
    if kind == "camera_path":
        paths = [
            {"camera_to_world": np.vstack([r, [0, 0, 0, 1]]).ravel().tolist(), "fov": 40}
            for r in rows
        ]
        value = {"camera_path": paths, "render_width": 20, "render_height": 16, "fps": 24}
    elif kind == "transforms":
        value = {"frames": [frame_keys(camera) for camera in cameras]}
    else:
        value = [
            {
                "id": i,
                "rotation": r[:, :3].tolist(),
                "position": r[:, 3].tolist(),
                "fx": 20,
                "fy": 21,
                "width": 16,
                "height": 16,
            }
            for i, r in enumerate(rows)
        ]
    file = case.folder / "cameras.json"
    file.write_text(json.dumps(value))
    case.label = f"{kind}, {changed_file(rng, file)}"
    for camera in (
        case.read(lambda: read_cameras(file, (16, 16) if rng.random() < 0.5 else None)) or ()
    ):
        check_camera(camera)


SURFACES |= {"images": images, "masks": masks, "cameras": cameras}
