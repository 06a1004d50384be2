"""The folder that `pp-cl make` fills: a page about a run, beside the files that it shows. It can be
written at any time, and shows what is there by then.
"""

import html
import json
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl import Run
from pp_cl.errors import name_of
from pp_cl.files import atomic_path, own, write_png, write_text
from pp_cl.scene import scene_frames
from pp_studio.capture.overview import overview
from pp_studio.export.gaussians import first_gaussians, fitted_gaussians
from pp_studio.export.page import filled, page_text, still

INDEX, MODEL, SPLAT = "index.html", "model.html", "splat.ply"
STILL, VIEWS, CAMERAS, MASKS = "thumbnail.png", "views.png", "cameras.png", "masks.png"
VIDEOS = ("video.mp4", "video.webp")
MINUTES = "minutes.json"  # those asked for, and those that have passed
LABELS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
WHAT = {
    MODEL: "the model alone, one page that needs no network",
    SPLAT: "3D Gaussians, for SuperSplat, Blender and other viewers",
    STILL: "an image of it",
} | dict.fromkeys(VIDEOS, "once around the object")
PLAN_WIDTH = 1000  # pixels of the drawing of the cameras


def begin_result(folder: Path) -> None:
    """Make the folder. Raises UserError where it holds other files, or one in the place of a file
    of the result that is not the program's.
    """
    names = (INDEX, MODEL, SPLAT, STILL, VIEWS, CAMERAS, MASKS, MINUTES, *VIDEOS)
    mend = "move it away, or choose another --out"
    own(folder, [folder / name for name in names], mend, alone=True)


def write_result(
    run: Run | None,
    split: str,
    folder: Path,
    video: str,
    told: Sequence[str] = (),
    scene: str = "",
) -> None:
    """Write index.html, the model's page and the images that it shows, beside the video and the
    splats, if those are newer than the run's checkpoint. What is not there yet is said to come.

    run: None before there is a checkpoint; then the cameras and masks of the scene are shown.
    split: whose evaluation is shown. video: the file's name. told: what is to be known of the
    photographs, a line each. scene: its path, or demo; the run's, unless given.
    """
    title, views, shown = name_of(folder), _later("evaluation"), set()
    if run:
        done = run.folder.checkpoint
        found: dict[str, Any] = {}
        if is_newer(run.folder.metrics(split), done):
            found = json.loads(run.folder.metrics(split).read_text("utf-8"))
            _copy(run.folder.evaluation(split) / "comparison.png", folder / VIEWS)
            whose = "that the training has not seen" if split != "train" else "of the training"
            text = f"Views {whose}: rendered, photographed, and four times their difference."
            views = f"<p>{text}</p>\n{_image(VIEWS, 'views beside their photographs')}"
        shown = {name for name in (video, SPLAT) if is_newer(folder / name, done)}
        if not is_newer(folder / MODEL, folder / SPLAT if SPLAT in shown else done):
            write_png(folder / STILL, still(run))
            gaussians = (fitted_gaussians if SPLAT in shown else first_gaussians)(run)
            write_text(folder / MODEL, page_text(run, gaussians, title=title))
        shown |= {MODEL, STILL}
        model = '<iframe src="model.html" title="The model; drag to turn it"></iframe>'
        rows = _figures(run, found)
        told = [*told, *run.header.get("notes", [])]
        if names := run.header.get("left_out"):
            told.append(f"left out, as their masks contradict the others': {', '.join(names)}")
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the training tells the same
            cameras = [one.camera for one in scene_frames(scene, "train")]
        model = "\n".join([_later("model"), *_plan(folder, Path(scene), cameras)])
        rows = [
            ("photographs for the training", str(len(cameras))),
            ("size of the photographs", f"{cameras[0].width}x{cameras[0].height}"),
        ]
    moving = _image(video, "the object from all sides")
    if video.endswith(".mp4"):
        moving = f'<video src="{video}" autoplay loop muted playsinline controls></video>'
    links = []
    for name in (MODEL, video, SPLAT, STILL):
        if name in shown:
            size = (folder / name).stat().st_size / 1e6
            links.append(f'<li><a href="{name}">{name}</a>, {size:.1f} MB: {WHAT[name]}</li>')
    items = "\n".join(f"<li>{html.escape(line)}</li>" for line in told)
    parts = {
        "title": html.escape(title),
        "model": model,
        "video": moving if video in shown else _later("video"),
        "views": views,
        "figures": "\n".join(
            f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
            for name, value in rows
        ),
        "notes": f"<h2>About the photographs</h2>\n<ul>\n{items}\n</ul>" if told else "",
        "files": "\n".join(links) or "<li>none yet</li>",
    }
    write_text(folder / INDEX, filled("result.html", parts, STILL if run else CAMERAS))


def is_newer(file: Path, other: Path) -> bool:
    """Whether a file is there, and was written after another one."""
    return file.exists() and file.stat().st_mtime_ns > other.stat().st_mtime_ns


def _plan(folder, scene, cameras):
    """Images of the cameras, and of the masks that a capture has found."""
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
    return f'<p class="later">The {what} is still to come; reload this page then.</p>'


def _figures(run, found):
    """[(name, value)] of the table, of what metrics.json holds, if it is there."""
    rows = [(LABELS[name], f"{value:.4g}") for name, value in found.get("mean", {}).items()]
    if rows:
        rows[0] = (rows[0][0], f"{rows[0][1]} (mean of {len(found['per_image'])} views)")
    cameras = run.cameras("train")
    return [
        *rows,
        ("photographs in the training", str(len(cameras))),
        ("size in the training", f"{cameras[0].width}x{cameras[0].height}"),
        ("points", f"{run.model.cloud.count:,}"),
        ("steps", f"{run.header['step']:,}"),
        ("device", run.dev.name),
    ]
