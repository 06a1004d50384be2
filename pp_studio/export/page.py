"""Runs as HTML files that a browser draws with WebGL2, without the network; a gallery of them."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pp_cl import Camera, Run
from pp_cl.engine import Grid
from pp_cl.errors import name_of
from pp_cl.files import atomic_folder, to_8bit, write_png, write_text
from pp_cl.scene import up_of
from pp_studio.camera_path import level
from pp_studio.export.gaussians import check_drawable
from pp_studio.export.harmonics import COUNT, fit_harmonics

# Bytes of a point: place (3, uint16), opacity (uint16), coefficients (27, uint8), logarithm of the
# radius (uint8).
POINT = np.dtype([("place", "<u2", 3), ("opacity", "<u2"), ("colour", "u1", 27), ("radius", "u1")])
OUTLIERS = 1e-3  # share of the coefficients at either end that is clipped: they would coarsen all
PLACES = np.iinfo(np.uint16).max
FIELD_OF_VIEW = 40.0  # degrees across the shorter side of the page
STILL = 600, 315  # pixels; the least that is shown large beside a link


def pack(run: Run, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The run's points with coefficients (N, 9, 3) of their colours, as the page keeps them: (N,)
    rows of POINT; low and span, (9,) float32: byte v of coefficient k stands for low[k] + span[k] v
    / 255.
    """
    origin, unit = lattice(run.model.grid)
    positions = run.model.positions()
    rows = np.zeros(len(positions), POINT)
    rows["place"] = np.rint((positions - origin) / unit)
    rows["opacity"] = np.rint(run.model.cloud.opacity.get() * 65535)
    by_function = coefficients.transpose(1, 0, 2).reshape(COUNT, -1)
    low, high = np.quantile(by_function, [OUTLIERS, 1 - OUTLIERS], axis=1).astype(np.float32)
    span = np.maximum(high - low, np.float32(1e-6))
    scaled = (coefficients - low[:, None]) / span[:, None] * 255
    cloud = run.model.cloud
    rows["radius"] = np.rint((cloud.offset.get()[:, 3] + cloud.most_offset) * 255)
    rows["colour"] = np.rint(scaled.clip(0, 255)).reshape(len(rows), -1)
    return rows, low, span


def lattice(grid: Grid) -> tuple[np.ndarray, float]:
    """(origin (3,), unit), in the world: places in the cells of a grid are kept as whole units from
    there, as small as 16 bits allow.
    """
    return np.array(grid.origin) - grid.voxel_size / 2, grid.voxel_size / (PLACES // max(grid.dims))


def page_text(run: Run, still: str = "", title: str = "") -> str:
    """The page. still: the file of an image that stands for it where it is linked to, if any.
    title: instead of the name of the run's folder. Raises UserError as check_drawable does.
    """
    check_drawable(run)
    rows, low, span = pack(run, fit_harmonics(run))
    points = base64.b64encode(rows.tobytes()).decode()
    return filled(
        "page.html",
        {
            "title": html.escape(title or name_of(run.folder.path)),
            "card": card(still),
            "about": f"{len(rows):,} points, {len(points) / 1e6:.1f} MB",
            "header": json.dumps(_header(run, low, span)).replace("<", "\\u003c"),
            "points": points,
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
    number. Raises UserError as check_drawable and atomic_folder do.
    """
    cards: dict[str, str] = {}
    with atomic_folder(folder) as unfinished:
        for run in runs:
            stem = re.sub(r"[^A-Za-z0-9_-]+", "-", name_of(run.folder.path)).strip("-") or "run"
            while stem.lower() in {"index", *map(str.lower, cards)}:  # as some disks take names
                stem += "-2"
            write_text(unfinished / f"{stem}.html", page_text(run, f"{stem}.png"))
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
    return to_8bit(run.render(camera).colour)


def _header(run, low, span):
    """What the page must know beside the points."""
    grid = run.model.grid
    origin, unit = lattice(grid)
    centre, _ = run.ball
    eye, up = first_look(run)
    return {
        "count": run.model.cloud.count,
        "stride": POINT.itemsize,
        "origin": origin.tolist(),
        "unit": unit,
        "radius": float(run.config.raster.radius * grid.voxel_size),
        "nearest": run.nearest,
        "centre": centre.tolist(),
        # of the finest camera, in world units at the distance of the centre
        "pixel": min(
            float(np.linalg.norm(camera.eye - centre)) / min(camera.fx, camera.fy)
            for camera in run.cameras("train")
        ),
        "low": low.tolist(),
        "span": span.tolist(),
        "eye": eye.tolist(),
        "up": up.tolist(),
        "fov": FIELD_OF_VIEW,
    }


def first_look(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """(eye, up), both (3,), with which a page begins: it looks at the middle of run.ball from the
    side of the first training view, 20 degrees above the horizon, and shows the whole ball.
    """
    centre, radius = run.ball
    cameras = run.cameras("train")
    up, rise = up_of(cameras), np.radians(20)
    towards = np.cos(rise) * level(cameras[0].eye - centre, up) + np.sin(rise) * up
    return centre + radius / np.sin(np.radians(FIELD_OF_VIEW) / 2) * towards, up
