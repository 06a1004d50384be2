"""Renders a run along a camera path: frames, which a later call resumes, and videos of them."""

import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pp_cl import Camera, RenderedView, Run, track
from pp_cl.errors import UserError
from pp_cl.files import (
    MANIFEST,
    check_file,
    check_ours,
    check_target,
    own,
    read_regular,
    read_rgba,
    remove_ours,
    write_exr,
    write_json,
    write_png,
)
from pp_studio.export.gaussians import FILE, drawn_by, kept_gaussians, window_camera
from pp_studio.large import MOST_PARTS, fineness, parts, render_large
from pp_studio.video import write_video

MOST_IDENTITY = 1000  # most bytes of the file IDENTITY
# bytes per pixel that Pillow keeps until the video is written, and the most that it may keep in all
PIXEL_BYTES, MOST_HELD = {".webp": 4, ".gif": 1}, 2**31
IDENTITY = "frames.json"  # says what the frames in a folder show
LOCK = ".pp-cl.lock"
GAUSSIANS = 0  # Style.parts if Gaussians are drawn
WRITING = 0.05  # seconds, about, to write a frame and its share of a video
FEWER_PARTS = 2  # tried if Style.parts would take too long (large.py says what it costs)


@dataclass(frozen=True)
class Style:
    """How frames are rendered and written.

    suffix: png or exr. background: sRGB in [0, 1], None: transparent; OpenEXR always is. samples:
    per pixel, a square number. features: OpenEXR files also hold the network's input. parts: a
    frame is woven of at most this many renderings, each way; GAUSSIANS: kept_gaussians() are drawn.
    """

    suffix: str = "png"
    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    samples: int = 1
    features: bool = False
    parts: int = MOST_PARTS


@dataclass(frozen=True)
class Rendered:
    """The result of render_frames(). seconds: of each new frame. paths: of all frames. why: a line
    that says how frames are drawn because the style would have taken too long, otherwise "".
    """

    seconds: list[float]
    paths: list[Path]
    why: str = ""


def render_frames(
    run: Run,
    cameras: Sequence[Camera],
    folder: Path,
    style: Style,
    *,
    minutes: float = math.inf,
    anew: bool = False,
) -> Rendered:
    """Render those frames of the cameras that are not in a folder yet.

    minutes: for all frames; if the style takes longer, they are drawn less finely, or by the
    Gaussians in the run's folder. anew: replace frames that show something else. Raises UserError
    if the folder cannot be made, holds other files or frames, or is in use by another process.
    """
    # Python represents bytes that are not UTF-8 by these
    if style.suffix == "exr" and any("\udc80" <= c <= "\udcff" for c in str(folder)):
        raise UserError(
            f"{folder}: OpenEXR writes no file whose name is no UTF-8; choose another --out"
        )
    paths = [folder / f"{i:05d}.{style.suffix}" for i in range(len(cameras))]
    if folder.exists():
        if not folder.is_dir():
            raise UserError(f"{folder}: is not a folder; choose another --out")
        _identity_of(folder)  # raises before a lock is made among other files
    check_target(folder / IDENTITY)
    folder.mkdir(parents=True, exist_ok=True)
    seconds, why = [], ""
    try:
        with FileLock(folder / LOCK, timeout=0):
            if minutes < math.inf:
                style, why = _affordable(run, cameras, style, minutes, _identity_of(folder))
            _begin(folder, paths, _identity(run, cameras, style), anew)
            draw = _drawer(run, style)
            frames = zip(cameras, paths, strict=True)
            for camera, path in track(frames, "rendering", "frame", len(paths)):
                if path.exists():
                    continue
                start = time.perf_counter()
                rendered = draw(camera)
                if style.suffix == "exr":
                    write_exr(path, rendered.channels())
                else:
                    write_png(path, rendered.over(style.background))
                seconds.append(time.perf_counter() - start)
    except Timeout:
        raise UserError(
            f"{folder}: another process renders there; wait for its end, or choose another --out"
        ) from None
    return Rendered(seconds, paths, why)


def render_video(
    run: Run,
    cameras: Sequence[Camera],
    video: Path,
    fps: float,
    style: Style,
    *,
    minutes: float = math.inf,
) -> Rendered:
    """Render a video. Its frames stay in a hidden folder beside it until it is written, so that a
    later call can go on. minutes: as for render_frames. Raises UserError as render_frames and
    write_video do, and if the frames of the video would fill the memory.
    """
    check_file(video)
    held = PIXEL_BYTES.get(video.suffix.lower(), 0) * sum(c.width * c.height for c in cameras)
    if held > MOST_HELD:
        raise UserError(
            f"{video}: in this format all frames are in memory at once, {held / 2**30:.1f} GiB;"
            " make it shorter or smaller, or write --format mp4"
        )
    folder = video.with_name(f".{video.name}.frames")
    rendered = render_frames(run, cameras, folder, style, minutes=minutes, anew=True)
    channels = 4 if style.background is None else 3
    write_video(video, (read_rgba(path)[..., :channels] for path in rendered.paths), fps)
    _remove_frames(folder)
    if {path.name for path in folder.iterdir()} <= {LOCK, MANIFEST}:
        shutil.rmtree(folder)
    return rendered


def _drawer(run: Run, style: Style) -> Callable[[Camera], RenderedView]:
    """The function that draws a frame in a style."""
    if style.parts:
        options: Any = {"samples": style.samples, "features": style.features}
        return lambda camera: render_large(run, camera, most=style.parts, **options)
    gaussians: Any = kept_gaussians(run)
    drawn = drawn_by(run, gaussians)

    def draw(camera):
        window = window_camera(camera, fineness(run, camera), gaussians)
        return drawn.render(window, samples=style.samples)

    return draw


def _affordable(run, cameras, style, minutes, there):
    """(the first style in which all frames fit in the minutes, else the last; Rendered.why). there:
    identity of frames already there; their style is kept.
    """
    ways = {style: ""}
    if parts(run, cameras[0], style.parts) > FEWER_PARTS:
        ways[replace(style, parts=FEWER_PARTS)] = "less finely"
    if not style.features and kept_gaussians(run):
        ways[replace(style, parts=GAUSSIANS)] = "as the run's 3D Gaussians, without its network"
    for way, how in ways.items():
        if there == _identity(run, cameras, way):
            return way, f"drawn {how}, as they were begun" if how else ""
    first = 0.0
    for way in ways:
        draw = _drawer(run, way)
        draw(cameras[0])  # builds the kernels
        start = time.perf_counter()
        draw(cameras[0])
        needed = (time.perf_counter() - start + WRITING) * len(cameras) / 60
        first = first or needed
        if needed <= minutes:
            break
    why = f"drawn {ways[way]}: otherwise they would take {first:.1f} minutes"
    return way, why if ways[way] else ""


def _begin(folder, paths, identity, anew):
    """Prepare a folder to hold only frames of this identity."""
    if _identity_of(folder) not in (None, identity):
        if not anew:
            raise UserError(
                f"{folder}: holds frames of another model, path or style; choose another --out,"
                " or delete it"
            )
        check_ours([*paths, folder / IDENTITY])
        _remove_frames(folder)
    own(folder)
    write_json(folder / IDENTITY, identity)


def _remove_frames(folder):
    """Remove the frames, and then what says of which model they are."""
    remove_ours(sorted(folder.iterdir(), key=lambda path: path.name == IDENTITY))


def _identity(run, cameras, style):
    """A digest of everything on which the frames depend, and their count."""
    model = run.model
    varied = run.renderer.supersampling, model.cloud.count, bool(model.specular), len(run.others)
    about = style, run.header["step"], run.config.raster, varied
    digest = hashlib.sha256(repr(about).encode())
    files = [run.folder.checkpoint]
    if style.parts == GAUSSIANS:  # another fit may take their place
        files += [file for file in [run.folder.path / FILE] if file.exists()]
    for file in files:
        stat = file.stat()
        digest.update(f"{stat.st_size} {stat.st_mtime_ns}".encode())
    for camera in cameras:
        digest.update(run.model.packed(camera).tobytes())
    return {"frames": digest.hexdigest(), "count": len(cameras)}


def _identity_of(folder):
    """The identity of a folder's frames, None without frames. Raises UserError for other files."""
    if all(path.name.startswith(".") for path in folder.iterdir()):
        return None
    try:
        return json.loads(read_regular(folder / IDENTITY, MOST_IDENTITY))
    except (OSError, ValueError, RecursionError):
        raise UserError(f"{folder}: holds files that are no frames; choose another --out") from None
