"""Runs as HTML files that a browser draws with WebGL2, without the network; a gallery of them."""

import base64
import html
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Camera, Run
from pp_cl.errors import name_of
from pp_cl.files import atomic_folder, to_8bit, write_png, write_text
from pp_cl.scene import up_of
from pp_studio.camera_path import level
from pp_studio.export.gaussians import Gaussians, fitted_gaussians
from pp_studio.export.harmonics import COUNT
from pp_studio.large import render_large

# A Gaussian's bytes: place in the box of all; opacity; logarithms of its deviations; x, y and z of
# the quaternion that turns its axes, of which the one with the largest w is taken, so that all lie
# within TURNED; coefficients of its colours, as Gaussians have them.
PACKED = np.dtype(
    [
        ("place", "<u2", 3),
        ("opacity", "u1"),
        ("deviations", "u1", 3),
        ("turn", "u1", 3),
        ("colour", "u1", 27),
    ]
)
OUTLIERS = 1e-3  # share of the coefficients at either end that is clipped: they would coarsen all
PLACES, TURNED = np.iinfo(np.uint16).max, 240
FIELD_OF_VIEW = 40.0  # degrees across the shorter side of the page
FILLED = 0.8  # of the shorter side, by the object as it is turned round; lines of text are above
SAMPLED_POINTS = 20_000
STILL = 600, 315  # pixels; the least that is shown large beside a link
HERE = Path(__file__).parent


def pack(table: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """Records of GAUSSIAN as the page keeps them: (N,) rows of PACKED, and what their bytes stand
    for: a place is corner + unit times the number; byte v of coefficient k, low[k] + span[k] v /
    255; of a deviation, the exponential of logarithms[0] + logarithms[1] v / 255.
    """
    rows, place = np.zeros(len(table), PACKED), table["position"].astype(np.float64)
    corner = place.min(axis=0)
    unit = max(float(np.ptp(place, axis=0).max()) / PLACES, 1e-30)
    rows["place"] = np.rint((place - corner) / unit)
    rows["opacity"] = np.rint(table["opacity"] * 255)
    deviations, rows["turn"] = _nearest_axes(table["deviations"], table["turn"])
    logs = np.log(np.maximum(deviations, np.finfo(np.float32).tiny))
    least, most = np.quantile(logs, [OUTLIERS, 1])
    logarithms = float(least), max(float(most - least), 1e-6)
    rows["deviations"] = np.rint(((logs - least) / logarithms[1]).clip(0, 1) * 255)
    by_function = table["harmonics"].transpose(1, 0, 2).reshape(COUNT, -1)
    low, high = np.quantile(by_function, [OUTLIERS, 1 - OUTLIERS], axis=1).astype(np.float32)
    span = np.maximum(high - low, np.float32(1e-6))
    scaled = (table["harmonics"] - low[:, None]) / span[:, None] * 255
    rows["colour"] = np.rint(scaled.clip(0, 255)).reshape(len(rows), -1)
    about = {"corner": corner.tolist(), "unit": unit, "low": low.tolist(), "span": span.tolist()}
    return rows, about | {"logarithms": logarithms}


def _nearest_axes(deviations, turn):
    """(deviations (N, 3), bytes (N, 3) of their axes), swapped so that they turn least."""
    ways = Rotation.create_group("O")
    own = Rotation.from_quat(np.roll(turn, -1, axis=1))
    # w of the product of two quaternions (x, y, z, w)
    quaternions, others = own.as_quat(), ways.as_quat() * [-1, -1, -1, 1]
    chosen = np.argmax(np.abs(quaternions @ others.T), axis=1)
    found = (own * ways[chosen]).as_quat(canonical=True)
    swapped = np.abs(ways.as_matrix())[chosen]
    kept = np.einsum("nji,nj->ni", swapped, deviations)
    return kept, np.rint(found[:, :3] * TURNED + 128).astype(np.uint8)


def page_text(run: Run, gaussians: Gaussians, still: str = "", title: str = "") -> str:
    """The page. gaussians: of the run. still: the file of an image that stands for it where it is
    linked to, if any. title: instead of the name of the run's folder.
    """
    rows, about = pack(gaussians.table)
    data, corner = base64.b64encode(rows.tobytes()).decode(), about.pop("corner")
    (centre, _), cameras, (eye, up) = run.ball, run.cameras("train"), first_look(run)
    # what a pixel of the training shows in the middle of the object
    pixels = [np.linalg.norm(one.eye - centre) / min(one.fx, one.fy) for one in cameras]
    header = about | {
        "count": len(rows),
        "origin": (gaussians.origin + corner).tolist(),
        "nearest": run.nearest,
        "centre": centre.tolist(),
        "pixel": float(np.median(pixels)),
        "windows": gaussians.windows,
        "low_pass": gaussians.low_pass,
        "eye": eye.tolist(),
        "up": up.tolist(),
        "fov": FIELD_OF_VIEW,
    }
    parts = {
        "title": html.escape(title or name_of(run.folder.path)),
        "about": f"{len(rows):,} Gaussians, {len(data) / 1e6:.1f} MB",
        "header": json.dumps(header).replace("<", "\\u003c"),
        "gaussians": data,
        "script": (HERE / "page.js").read_text("utf-8"),
    }
    return filled("page.html", parts, still)


def filled(template: str, parts: dict[str, str], still: str) -> str:
    """A template of this folder with its parts, {name: text}. still: the image that programs show
    beside a link to the page, if any.
    """
    large = '<meta name="twitter:card" content="summary_large_image">'
    card = f'<meta property="og:image" content="{still}">\n{large}' if still else ""
    page = (HERE / template).read_text("utf-8")
    for name, text in ({"card": card} | parts).items():
        page = page.replace(f"<!-- {name} -->", text)
    return page


def write_gallery(folder: Path, runs: Iterable[Run]) -> int:
    """Write a page and a still of each run into a folder, with an index of them; returns their
    number. Raises UserError as fitted_gaussians and atomic_folder do.
    """
    stems: list[str] = []
    figures = []
    with atomic_folder(folder) as unfinished:
        for run in runs:
            name = name_of(run.folder.path)
            stem = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-") or "run"
            while stem.lower() in {"index", *map(str.lower, stems)}:  # as some disks take names
                stem += "-2"
            stems.append(stem)
            page = page_text(run, fitted_gaussians(run), f"{stem}.png")
            write_text(unfinished / f"{stem}.html", page)
            write_png(unfinished / f"{stem}.png", still(run))
            image = f'<img src="{stem}.png" alt="">'
            figures.append(f'<a href="{stem}.html">{image}{html.escape(name)}</a>')
        page = filled("gallery.html", {"figures": "\n".join(figures)}, f"{stems[0]}.png")
        write_text(unfinished / "index.html", page)
    return len(stems)


def still(run: Run) -> np.ndarray:
    """(H, W, 3) uint8: the run as a page of it begins, as large as STILL."""
    (eye, up), (width, height) = first_look(run), STILL
    focal = height / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    camera = Camera.look_at(eye, run.ball[0], up, fx=focal, width=width, height=height)
    return to_8bit(render_large(run, camera).colour)


def first_look(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """(eye, up), both (3,), with which a page begins: it looks at the middle of run.ball from the
    side of the first training view, 20 degrees above the horizon, and shows the whole object, also
    when it is turned round.
    """
    centre, cameras = run.ball[0], run.cameras("train")
    up, rise = up_of(cameras), np.radians(20)
    ahead = level(cameras[0].eye - centre, up)
    points = run.model.positions() - centre
    points = points[:: max(1, len(points) // SAMPLED_POINTS)]
    half, distance = FILLED * np.tan(np.radians(FIELD_OF_VIEW) / 2), 0.0
    for angle in np.radians(range(0, 360, 15)):
        side = np.cos(angle) * ahead + np.sin(angle) * np.cross(up, ahead)
        towards = np.cos(rise) * side + np.sin(rise) * up
        right = np.cross(up, side)
        across = np.abs(points @ np.stack([right, np.cross(towards, right)], axis=1)).max(axis=1)
        distance = max(distance, float((across / half + points @ towards).max()))
    return centre + distance * (np.cos(rise) * ahead + np.sin(rise) * up), up
