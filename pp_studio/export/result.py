"""Writes the folder that `pp-cl make` fills: a page about a run, beside the files that it shows.
The page can be written at any time, shows what is there, and reloads itself until everything is.
"""

import html
import shutil
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl import Camera, Run, Training
from pp_cl.engine import Renderer
from pp_cl.files import atomic_path, own, write_png, write_text
from pp_cl.scene import read_json, scene_frames
from pp_studio.capture.overview import overview
from pp_studio.export.gaussians import Gaussians, first_gaussians, fitted_gaussians
from pp_studio.export.page import HERE, filled, page_text, still

INDEX, MODEL, SPLAT = "index.html", "model.html", "splat.ply"
STILL, VIEWS, CAMERAS, MASKS = "thumbnail.png", "views.png", "cameras.png", "masks.png"
VIDEOS = ("video.mp4", "video.webp")
VERSION = "version.js"  # tells an open page the newest version
STATE = "make.json"  # lets the same command go on
LABELS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
WHAT = {
    MODEL: "the model alone, one page that needs no network",
    SPLAT: "3D Gaussians, for SuperSplat, Blender and other viewers",
    STILL: "an image of it",
} | dict.fromkeys(VIDEOS, "once around the object")
PLAN_WIDTH = 1000  # width in pixels of the drawing of the cameras


def begin_result(folder: Path) -> None:
    """Make the folder. Raises UserError if it holds other files, or if a file in the place of one
    of the result's is not the program's.
    """
    names = (INDEX, MODEL, SPLAT, STILL, VIEWS, CAMERAS, MASKS, VERSION, STATE, *VIDEOS)
    mend = "move it away, or choose another --out"
    own(folder, [folder / name for name in names], mend, alone=True)


def write_model(folder: Path, gaussians: Gaussians, cameras: Sequence[Camera], title: str) -> None:
    """Write the model's page. cameras: those of the photographs."""
    write_text(folder / MODEL, page_text(gaussians, cameras, title))


def write_result(
    folder: Path,
    title: str,
    video: str,
    *,
    run: Run | None = None,
    split: str = "",
    scene: str = "",
    told: Sequence[str] = (),
    state: str = "",
) -> None:
    """Write index.html and its images. The page shows the run's model and, if they are newer than
    the checkpoint, the video and the splats; it announces anything missing.

    run: None before the first checkpoint; the page then shows the scene's cameras and masks, and
    the model's page if there is one. split: whose evaluation is shown. video: the file's name.
    scene: its path, or demo. told: lines about the photographs. state: what is still to be done, in
    words; "" if nothing is, and the page does not reload.
    """
    views, shown = _later("evaluation"), set()
    if run:
        done = run.folder.checkpoint
        evaluation: dict[str, Any] = {}
        if is_newer(run.folder.metrics(split), done):
            evaluation = read_json(run.folder.metrics(split))
            _copy(run.folder.evaluation(split) / "comparison.png", folder / VIEWS)
            whose = "that the training has not seen" if split != "train" else "of the training"
            text = f"Views {whose}: rendered, photographed, and four times their difference."
            views = f"<p>{text}</p>\n{_image(VIEWS, 'views beside their photographs')}"
        shown = {name for name in (video, SPLAT) if is_newer(folder / name, done)}
        is_made = is_newer(folder / MODEL, folder / SPLAT if SPLAT in shown else done)
        if not (is_made and (folder / STILL).exists()):
            write_png(folder / STILL, still(run))
            gaussians = (fitted_gaussians if SPLAT in shown else first_gaussians)(run)
            write_model(folder, gaussians, run.cameras("train"), title)
        shown |= {MODEL, STILL}
        plan, rows = [], _figures(run, evaluation)
        told = [*told, *run.header.get("notes", [])]
        if names := run.header.get("left_out"):
            told.append(f"left out, as their masks contradict the others': {', '.join(names)}")
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the training gives the same warnings
            cameras = [frame.camera for frame in scene_frames(scene, "train")]
        shown = {MODEL} if (folder / MODEL).exists() else set()
        plan = _plan(folder, Path(scene), cameras)
        rows = [
            ("photographs for the training", str(len(cameras))),
            ("size of the photographs", f"{cameras[0].width}x{cameras[0].height}"),
        ]
    model = '<iframe title="The model; drag to turn it"></iframe>'
    moving = _image(video, "the object from all sides")
    if video.endswith(".mp4"):
        moving = f'<video src="{video}" autoplay loop muted playsinline controls></video>'
    links = []
    for name in (MODEL, video, SPLAT, STILL):
        if name in shown:
            size = (folder / name).stat().st_size / 1e6
            links.append(f'<li><a href="{name}">{name}</a>, {size:.1f} MB: {WHAT[name]}</li>')
    items = "\n".join(f"<li>{html.escape(line)}</li>" for line in told)
    version = str(time.time_ns()) if state else ""
    parts = {
        "title": html.escape(title),
        "model": model if MODEL in shown else _later("model"),
        "state": "\n".join([f'<p class="state">{html.escape(state)}</p>'] * bool(state) + plan),
        "video": moving if video in shown else _later("video"),
        "views": views,
        "figures": "\n".join(
            f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
            for name, value in rows
        ),
        "notes": f"<p>About the photographs:</p>\n<ul>\n{items}\n</ul>" if told else "",
        "files": "\n".join(links) or "<li>none yet</li>",
        "script": (HERE / "result.js").read_text("utf-8"),
        "version": version,
    }
    write_text(folder / INDEX, filled("result.html", parts, STILL if run else CAMERAS))
    write_text(folder / VERSION, f'ppclVersion("{version}");\n')  # last: it makes pages reload


def write_preview(training: Training, folder: Path, title: str) -> None:
    """Write the model's page for the present state of a training, between two steps. Raises
    UserError as first_gaussians does.
    """
    run, renderer = training.present_run(), training.trainer.renderer
    renderer.release()
    # its own renderer: the training's would keep room for the fragments of whole images
    run.renderer = Renderer(run.dev, run.model, run.config.raster)
    try:
        gaussians = first_gaussians(run)
    finally:
        run.renderer.release()
    write_model(folder, gaussians, run.cameras("train"), title)


def is_newer(file: Path, other: Path) -> bool:
    """Whether a file exists and was written after another."""
    return file.exists() and file.stat().st_mtime_ns > other.stat().st_mtime_ns


def _plan(folder, scene, cameras):
    """Write images of the cameras and of a capture's masks; return their HTML."""
    capture = scene / "capture"
    if (capture / "box.png").is_file():
        _copy(capture / "box.png", folder / CAMERAS)
    else:
        nothing = np.empty((0, 3))
        write_png(folder / CAMERAS, overview(cameras, None, nothing, nothing, PLAN_WIDTH))
    images = [_image(CAMERAS, "the cameras, from the side and from above")]
    if (capture / "masks.png").is_file():
        _copy(capture / "masks.png", folder / MASKS)
        images.append(_image(MASKS, "the object in each photograph"))
    return images


def _copy(file, to):
    with atomic_path(to) as temporary:
        shutil.copyfile(file, temporary)


def _image(name, what):
    return f'<img src="{name}" alt="{what}">'


def _later(what):
    return f'<p class="later">The {what} is still to come.</p>'


def _figures(run, evaluation):
    """[(name, value)] of the table. evaluation: the contents of metrics.json, {} if none."""
    rows = [(LABELS[name], f"{value:.4g}") for name, value in evaluation.get("mean", {}).items()]
    if rows:
        many = f"{len(evaluation['per_image'])} views"
        if size := evaluation.get("size"):
            many += f" of {size[0]}x{size[1]}"
        rows[0] = (rows[0][0], f"{rows[0][1]} (mean of {many})")
    cameras = run.cameras("train")
    decisions = (why.partition(": ") for why in run.config.decisions.values())
    return [
        *rows,
        ("photographs in the training", str(len(cameras))),
        ("size in the training", f"{cameras[0].width}x{cameras[0].height}"),
        ("points", f"{run.model.cloud.count:,}"),
        ("steps", f"{run.header['step']:,}"),
        ("device", run.dev.name),
        *((key, value) for key, _, value in decisions),
    ]
