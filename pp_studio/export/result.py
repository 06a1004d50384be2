"""The folder that `pp-cl make` fills: a page about a run, beside the files that it shows. It can be
written at any time, and shows what is there by then.
"""

from __future__ import annotations

import html
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl import Run
from pp_cl.errors import name_of
from pp_cl.files import atomic_file, own, write_png, write_text
from pp_cl.scene import scene_frames
from pp_studio.capture.overview import overview
from pp_studio.export.page import card, filled, fitted, page_text, still, unfitted

INDEX, MODEL, SPLAT = "index.html", "model.html", "splat.ply"
STILL, VIEWS, CAMERAS, MASKS = "thumbnail.png", "views.png", "cameras.png", "masks.png"
VIDEOS = ("video.mp4", "video.webp")
MINUTES = "minutes.json"  # those asked for, and those that have passed
LABELS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
WHAT = {
    MODEL: "the model alone, one page that needs no network",
    SPLAT: "3D Gaussians, for SuperSplat, Blender and other viewers",
    STILL: "an image of it",
}
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
    splats, of which those that are older than the run's checkpoint do not count. What is not there
    yet is said to come, so that this can be called after each step of the work.

    run: None before there is a checkpoint; then the cameras and masks of the scene are shown.
    split: whose evaluation is shown. video: the file's name. told: what is to be known of the
    photographs, a line each. scene: its path, or demo; the run's, unless given.
    """
    title, views, shown = name_of(folder), "", set()
    if run:
        done = run.folder.checkpoint
        found: dict[str, Any] = {}
        if is_newer(run.folder.metrics(split), done):
            found = json.loads(run.folder.metrics(split).read_text("utf-8"))
            _copy(run.folder.evaluation(split) / "comparison.png", folder / VIEWS)
            views = _views(split)
        shown = {name for name in (video, SPLAT) if is_newer(folder / name, done)}
        if not is_newer(folder / MODEL, folder / SPLAT if SPLAT in shown else done):
            write_png(folder / STILL, still(run))
            gaussians = fitted(run) if SPLAT in shown else unfitted(run)
            write_text(folder / MODEL, page_text(run, gaussians, title=title))
        shown |= {MODEL, STILL}
        model = '<iframe src="model.html" title="The model; drag to turn it"></iframe>'
        rows, told = _figures(run, found), [*told, *_left_out(run)]
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the training tells the same
            listed = scene_frames(scene, "train")
        model = "\n".join([_later("model"), *_plan(folder, Path(scene), listed)])
        size = listed[0].camera
        rows = [
            ("photographs for the training", str(len(listed))),
            ("size of the photographs", f"{size.width}x{size.height}"),
        ]
    links = [_link(folder / name) for name in (MODEL, video, SPLAT, STILL) if name in shown]
    parts = {
        "title": html.escape(title),
        "card": card(STILL if run else CAMERAS),
        "model": model,
        "video": _player(video) if video in shown else _later("video"),
        "views": views or _later("evaluation"),
        "figures": "\n".join(_row(*row) for row in rows),
        "notes": _notes(told),
        "files": "\n".join(links) or "<li>none yet</li>",
    }
    write_text(folder / INDEX, filled("result.html", parts))


def is_newer(file: Path, other: Path) -> bool:
    """Whether a file is there, and was written after another one."""
    return file.exists() and file.stat().st_mtime_ns > other.stat().st_mtime_ns


def _plan(folder, scene, listed):
    """Images of the cameras, and of the masks that a capture has found."""
    capture = scene / "capture"
    if (capture / "box.png").is_file():
        _copy(capture / "box.png", folder / CAMERAS)
    else:
        nothing = np.empty((0, 3))
        drawn = overview([one.camera for one in listed], None, nothing, nothing, PLAN_WIDTH)
        write_png(folder / CAMERAS, drawn)
    images = [_image(CAMERAS, "the cameras, from the side and from above")]
    if (capture / "masks.png").is_file():
        _copy(capture / "masks.png", folder / MASKS)
        images.append(_image(MASKS, "the object in each photograph"))
    return images


def _copy(file, to):
    with atomic_file(to) as out:
        out.write(file.read_bytes())


def _views(split):
    views = "that the training has not seen" if split != "train" else "of the training"
    text = f"Views {views}: rendered, photographed, and four times their difference."
    return f"<p>{text}</p>\n{_image(VIEWS, 'views beside their photographs')}"


def _later(what):
    return f'<p class="later">The {what} is still to come; reload this page then.</p>'


def _figures(run, found):
    """[(name, value)] of the table, of what metrics.json holds, if it is there."""
    rows = [(LABELS[name], f"{value:.4g}") for name, value in found.get("mean", {}).items()]
    if rows:
        rows[0] = (rows[0][0], f"{rows[0][1]} (mean of {len(found['per_image'])} views)")
    cameras = run.cameras("train")
    rows += [
        ("photographs in the training", str(len(cameras))),
        ("size in the training", f"{cameras[0].width}x{cameras[0].height}"),
        ("points", f"{run.model.cloud.count:,}"),
        ("steps", f"{run.header['step']:,}"),
        ("device", run.dev.name),
    ]
    return rows


def _left_out(run):
    """What the training says of its photographs."""
    names = run.header.get("left_out", [])
    told = [f"left out, as their masks contradict the others': {', '.join(names)}"] if names else []
    return [*run.header.get("notes", []), *told]


def _row(name, value):
    return f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"


def _notes(lines):
    if not lines:
        return ""
    items = "\n".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f"<h2>About the photographs</h2>\n<ul>\n{items}\n</ul>"


def _player(name):
    if name.endswith(".mp4"):
        return f'<video src="{name}" autoplay loop muted playsinline controls></video>'
    return _image(name, "the object from all sides")


def _image(name, what):
    return f'<img src="{name}" alt="{html.escape(what)}">'


def _link(file):
    what = WHAT.get(file.name, "once around the object")
    size = file.stat().st_size / 1e6
    return f'<li><a href="{file.name}">{file.name}</a>, {size:.1f} MB: {what}</li>'
