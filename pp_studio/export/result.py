"""The folder that `pp-cl make` fills: a page about a run, beside the files that it shows."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pp_cl import Run
from pp_cl.errors import name_of
from pp_cl.files import atomic_file, own, write_png, write_text
from pp_studio.export.page import card, filled, page_text, still

INDEX, MODEL, SPLAT = "index.html", "model.html", "splat.ply"
STILL, VIEWS = "thumbnail.png", "views.png"
VIDEOS = ("video.mp4", "video.webp")
LABELS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
WHAT = {
    MODEL: "the model alone, one page that needs no network",
    SPLAT: "3D Gaussians, for SuperSplat, Blender and other viewers",
    STILL: "an image of it",
}


def begin_result(folder: Path) -> None:
    """Make the folder. Raises UserError where it holds other files, or one in the place of a file
    of the result that is not the program's.
    """
    files = [folder / name for name in (INDEX, MODEL, SPLAT, STILL, VIEWS, *VIDEOS)]
    own(folder, files, "move it away, or choose another --out", alone=True)


def write_result(run: Run, split: str, folder: Path, video: str, told: Sequence[str] = ()) -> None:
    """Write index.html, the model's page and the images that it shows, beside the video and the
    splats that are there already.

    split: whose evaluation is shown. video: the file's name. told: what is to be known of the
    photographs, a line each.
    """
    measured = run.folder.evaluation(split)
    found = json.loads((measured / "metrics.json").read_text("utf-8"))
    with atomic_file(folder / VIEWS) as file:
        file.write((measured / "comparison.png").read_bytes())
    write_png(folder / STILL, still(run))
    title = name_of(folder)
    write_text(folder / MODEL, page_text(run, title=title))
    names = (MODEL, video, SPLAT, STILL)
    views = "that the training has not seen" if split != "train" else "of the training"
    parts = {
        "title": html.escape(title),
        "card": card(STILL),
        "video": _player(video),
        "views": f"Views {views}: rendered, photographed, and four times their difference.",
        "figures": "\n".join(_row(*row) for row in _figures(run, found)),
        "notes": _notes([*told, *_left_out(run)]),
        "files": "\n".join(_link(folder / name) for name in names),
    }
    write_text(folder / INDEX, filled("result.html", parts))


def _figures(run, found: dict[str, Any]):
    """[(name, value)] of the table, of what metrics.json holds."""
    rows = [(LABELS[name], f"{value:.4g}") for name, value in found["mean"].items()]
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
    return f'<img src="{name}" alt="the object from all sides">'


def _link(file):
    what = WHAT.get(file.name, "once around the object")
    size = file.stat().st_size / 1e6
    return f'<li><a href="{file.name}">{file.name}</a>, {size:.1f} MB: {what}</li>'
