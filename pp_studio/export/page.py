"""Runs as HTML files that a browser draws with WebGL2, without the network; a gallery of them."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Camera, Run
from pp_cl.errors import name_of
from pp_cl.files import atomic_folder, to_8bit, write_png, write_text
from pp_cl.scene import up_of
from pp_studio.camera_path import level
from pp_studio.export.gaussians import (
    LARGEST,
    LOW_PASS,
    first_gaussians,
    fitted_gaussians,
    kept_gaussians,
    windows,
)
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


class Gaussians(NamedTuple):
    """table, origin: as fitted_gaussians() gives them. windows: least and most pixels of a window,
    for one of the run's images each way, in which they look right with all variances on the screen
    widened by low_pass, pixels^2.
    """

    table: np.ndarray
    origin: np.ndarray
    windows: tuple[float, float]
    low_pass: float


def fitted(run: Run) -> Gaussians:
    """The run's Gaussians for viewers. Raises UserError as fitted_gaussians does."""
    longest = max(max(camera.width, camera.height) for camera in run.cameras("train"))
    reduced = max(1, round(longest / LARGEST))  # as the fit reduces them
    least, most = windows(longest / reduced)
    table, origin = kept_gaussians(run) or fitted_gaussians(run)
    return Gaussians(table, origin, (least / reduced, most / reduced), LOW_PASS)


def unfitted(run: Run) -> Gaussians:
    """The run's points as Gaussians, for a page before there is time to fit them. Raises UserError
    as first_gaussians does.
    """
    return Gaussians(*first_gaussians(run), (1.0, 1.0), 0.0)


def _pixel(run):
    """What a pixel of the training shows in the middle of the object."""
    centre, cameras = run.ball[0], run.cameras("train")
    return float(np.median([np.linalg.norm(c.eye - centre) / min(c.fx, c.fy) for c in cameras]))


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
    lists = {"low": low.tolist(), "span": span.tolist(), "logarithms": logarithms}
    return rows, {"corner": corner.tolist(), "unit": unit, **lists}


def _nearest_axes(deviations, turn):
    """(deviations (N, 3), bytes (N, 3) of their axes): axes may be swapped with their deviations,
    and be turned round; of the 24 ways that which turns them least.
    """
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
    data = base64.b64encode(rows.tobytes()).decode()
    corner = about.pop("corner")
    header = json.dumps(about | _header(run, gaussians, corner))
    return filled(
        "page.html",
        {
            "title": html.escape(title or name_of(run.folder.path)),
            "card": card(still),
            "about": f"{len(rows):,} Gaussians, {len(data) / 1e6:.1f} MB",
            "header": header.replace("<", "\\u003c"),
            "gaussians": data,
            "script": (Path(__file__).parent / "page.js").read_text("utf-8"),
        },
    )


def card(still: str) -> str:
    """What programs that show links read of a page's image."""
    large = '<meta name="twitter:card" content="summary_large_image">'
    return f'<meta property="og:image" content="{still}">\n{large}' if still else ""


def filled(template: str, parts: dict[str, str]) -> str:
    """A template of this folder with its parts, {name: text}."""
    page = (Path(__file__).parent / template).read_text("utf-8")
    for name, text in parts.items():
        page = page.replace(f"<!-- {name} -->", text)
    return page


def write_gallery(folder: Path, runs: Iterable[Run]) -> int:
    """Write a page and a still of each run into a folder, with an index of them; returns their
    number. Raises UserError as fitted_gaussians and atomic_folder do.
    """
    cards: dict[str, str] = {}
    with atomic_folder(folder) as unfinished:
        for run in runs:
            stem = re.sub(r"[^A-Za-z0-9_-]+", "-", name_of(run.folder.path)).strip("-") or "run"
            while stem.lower() in {"index", *map(str.lower, cards)}:  # as some disks take names
                stem += "-2"
            write_text(unfinished / f"{stem}.html", page_text(run, fitted(run), f"{stem}.png"))
            write_png(unfinished / f"{stem}.png", still(run))
            cards[stem] = html.escape(name_of(run.folder.path))
        figures = [
            f'<a href="{stem}.html"><img src="{stem}.png" alt="">{name}</a>'
            for stem, name in cards.items()
        ]
        parts = {"card": card(f"{next(iter(cards))}.png"), "figures": "\n".join(figures)}
        write_text(unfinished / "index.html", filled("gallery.html", parts))
    return len(cards)


def still(run: Run) -> np.ndarray:
    """(H, W, 3) uint8: the run as a page of it begins, as large as STILL."""
    centre, _ = run.ball
    eye, up = first_look(run)
    width, height = STILL
    focal = height / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    camera = Camera.look_at(eye, centre, up, fx=focal, width=width, height=height)
    return to_8bit(render_large(run, camera).colour)


def _header(run, gaussians, corner):
    """What the page must know beside the Gaussians' bytes."""
    centre, _ = run.ball
    eye, up = first_look(run)
    return {
        "count": len(gaussians.table),
        "origin": (gaussians.origin + corner).tolist(),
        "nearest": run.nearest,
        "centre": centre.tolist(),
        "pixel": _pixel(run),
        "windows": gaussians.windows,
        "low_pass": gaussians.low_pass,
        "eye": eye.tolist(),
        "up": up.tolist(),
        "fov": FIELD_OF_VIEW,
    }


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
