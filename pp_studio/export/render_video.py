"""Renders a run along a camera path: frames, resumed by a later call, and videos of them."""

import hashlib
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from pp_cl import Camera, Run, track
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
from pp_studio.large import render_large
from pp_studio.video import write_video

MOST_IDENTITY = 1000  # bytes of it
# bytes of a frame's pixel that Pillow keeps until the video is written, and of all that it may
PIXEL_BYTES, MOST_HELD = {".webp": 4, ".gif": 1}, 2**31
IDENTITY = "frames.json"  # in the folder of the frames: what they show
LOCK = ".pp-cl.lock"


@dataclass(frozen=True)
class Style:
    """How frames are rendered and written.

    suffix: png or exr. background: sRGB in [0, 1], None: transparent; OpenEXR always is. samples:
    per pixel, a square number. features: in OpenEXR, the network's input too.
    """

    suffix: str = "png"
    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    samples: int = 1
    features: bool = False


def render_frames(
    run: Run, cameras: Sequence[Camera], folder: Path, style: Style, *, replace: bool = False
) -> tuple[list[float], list[Path]]:
    """Render the frames of the cameras that are not there yet into a folder; returns the seconds of
    each that was not, and all files.

    replace: frames of something else make room. Raises UserError for a folder that cannot be made,
    holds other files or frames, or that another process renders into.
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
    seconds = []
    try:
        with FileLock(folder / LOCK, timeout=0):
            _begin(folder, paths, _identity(run, cameras, style), replace)
            frames = zip(cameras, paths, strict=True)
            for camera, path in track(frames, "rendering", "frame", len(paths)):
                if path.exists():
                    continue
                start = time.perf_counter()
                rendered = render_large(run, camera, samples=style.samples, features=style.features)
                if style.suffix == "exr":
                    write_exr(path, rendered.channels())
                else:
                    write_png(path, rendered.over(style.background))
                seconds.append(time.perf_counter() - start)
    except Timeout:
        raise UserError(
            f"{folder}: another process renders there; wait for its end, or choose another --out"
        ) from None
    return seconds, paths


def render_video(
    run: Run, cameras: Sequence[Camera], video: Path, fps: float, style: Style
) -> list[float]:
    """Render a video, whose frames are in a hidden folder beside it until it is written, for a
    later call to go on with; returns the seconds of each frame that was not there. Raises UserError
    as render_frames and write_video do, and for a video whose frames would fill the memory.
    """
    check_file(video)
    held = PIXEL_BYTES.get(video.suffix.lower(), 0) * sum(c.width * c.height for c in cameras)
    if held > MOST_HELD:
        raise UserError(
            f"{video}: in this format all frames are in memory at once, {held / 2**30:.1f} GiB;"
            " make it shorter or smaller, or write --format mp4"
        )
    folder = video.with_name(f".{video.name}.frames")
    seconds, paths = render_frames(run, cameras, folder, style, replace=True)
    channels = 4 if style.background is None else 3
    write_video(video, (read_rgba(path)[..., :channels] for path in paths), fps)
    remove_ours(folder.iterdir())
    if {path.name for path in folder.iterdir()} <= {LOCK, MANIFEST}:
        shutil.rmtree(folder)
    return seconds


def _begin(folder, paths, identity, replace):
    """Have a folder hold frames of this identity alone."""
    if _identity_of(folder) not in (None, identity):
        if not replace:
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
