"""Renders a run along a camera path: frames, resumed by a later call, and videos of them."""

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
from pp_studio.export.gaussians import drawn_by, kept_gaussians, window_camera
from pp_studio.large import MOST_PARTS, fineness, parts, render_large
from pp_studio.video import write_video

MOST_IDENTITY = 1000  # bytes of it
# bytes of a frame's pixel that Pillow keeps until the video is written, and of all that it may
PIXEL_BYTES, MOST_HELD = {".webp": 4, ".gif": 1}, 2**31
IDENTITY = "frames.json"  # in the folder of the frames: what they show
LOCK = ".pp-cl.lock"
GAUSSIANS = 0  # in place of a number of parts
WRITING = 0.05  # seconds, about, that a frame takes to be written, and its share of a video
FEWER_PARTS = 2  # where as many as there may be would take too long (large.py says what it costs)


@dataclass(frozen=True)
class Style:
    """How frames are rendered and written.

    suffix: png or exr. background: sRGB in [0, 1], None: transparent; OpenEXR always is. samples:
    per pixel, a square number. features: in OpenEXR, the network's input too. parts: at most so
    many renderings, each way, that a frame is woven of; GAUSSIANS: those of kept_gaussians() are
    drawn.
    """

    suffix: str = "png"
    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    samples: int = 1
    features: bool = False
    parts: int = MOST_PARTS


@dataclass(frozen=True)
class Rendered:
    """What render_frames() has done. seconds: of each frame that was not there. paths: of all. why:
    a line on how frames are drawn that would have taken too long, "" of others.
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
    """Render the frames of the cameras that are not there yet into a folder.

    minutes: for all frames; where the style takes longer, they are drawn less finely, or by the
    Gaussians that the run's folder keeps. anew: frames of something else make room. Raises
    UserError for a folder that cannot be made, holds other files or frames, or that another process
    renders into.
    """
    # Python stands for bytes that are no UTF-8 by these
    if style.suffix == "exr" and any("\udc80" <= c <= "\udcff" for c in str(folder)):
        raise UserError(
            f"{folder}: OpenEXR writes no file whose name is no UTF-8; choose another --out"
        )
    paths = [folder / f"{i:05d}.{style.suffix}" for i in range(len(cameras))]
    if folder.exists():
        if not folder.is_dir():
            raise UserError(f"{folder}: is not a folder; choose another --out")
        _identity_of(folder)  # no lock is made in a folder of others
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
    """Render a video, whose frames are in a hidden folder beside it until it is written, for a
    later call to go on with. minutes: of render_frames. Raises UserError as render_frames and
    write_video do, and for a video whose frames would fill the memory.
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
    remove_ours(folder.iterdir())
    if {path.name for path in folder.iterdir()} <= {LOCK, MANIFEST}:
        shutil.rmtree(folder)
    return rendered


def _drawer(run: Run, style: Style) -> Callable[[Camera], RenderedView]:
    """What draws a frame."""
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
    """(the first of some styles with which all frames take these minutes, else the last, Rendered.
    why). there: identity of frames that are there, with whose style the others are drawn.
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
        draw(cameras[0])  # builds kernels
        start = time.perf_counter()
        draw(cameras[0])
        needed = (time.perf_counter() - start + WRITING) * len(cameras) / 60
        first = first or needed
        if needed <= minutes:
            break
    why = f"drawn {ways[way]}: otherwise they would take {first:.1f} minutes"
    return way, why if ways[way] else ""


def _begin(folder, paths, identity, anew):
    """Have a folder hold frames of this identity alone."""
    if _identity_of(folder) not in (None, identity):
        if not anew:
            raise UserError(
                f"{folder}: holds frames of another model, path or style; choose another --out,"
                " or delete it"
            )
        check_ours([*paths, folder / IDENTITY])
        remove_ours(folder.iterdir())
    own(folder)
    write_json(folder / IDENTITY, identity)


def _identity(run, cameras, style):
    """Of everything that the frames depend on."""
    checkpoint, model = run.folder.checkpoint.stat(), run.model
    varied = run.renderer.supersampling, model.cloud.count, bool(model.specular), len(run.others)
    about = style, run.header["step"], run.config.raster, varied
    digest = hashlib.sha256(repr(about).encode())
    digest.update(f"{checkpoint.st_size} {checkpoint.st_mtime_ns}".encode())
    for camera in cameras:
        digest.update(run.model.packed(camera).tobytes())
    return {"frames": digest.hexdigest(), "count": len(cameras)}


def _identity_of(folder):
    """What the frames in a folder show, None where there are none. Raises UserError for others."""
    if all(path.name.startswith(".") for path in folder.iterdir()):
        return None
    try:
        return json.loads(read_regular(folder / IDENTITY, MOST_IDENTITY))
    except (OSError, ValueError, RecursionError):
        raise UserError(f"{folder}: holds files that are no frames; choose another --out") from None
