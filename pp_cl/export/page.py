"""A run as one HTML file that a browser draws with WebGL2, without the network."""

from __future__ import annotations

import base64
import html
import json
import os
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError
from pp_cl.export.harmonics import COUNT, fit_harmonics
from pp_cl.run import NEAREST, Run

# Bytes of a point: vertex (3, uint16), opacity (uint16), coefficients (27 and 1 unused, uint8).
POINT = np.dtype([("vertex", "<u2", 3), ("opacity", "<u2"), ("colour", "u1", 28)])
OUTLIERS = 1e-3  # share of the coefficients at either end that is clipped: they would coarsen all
FIELD_OF_VIEW = 40.0  # degrees from the top of the page to its bottom


def pack(run: Run, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The run's points with coefficients (N, 9, 3) of their colours, as the page keeps them: (N,)
    rows of POINT; low and span, (9,) float32: byte v of coefficient k stands for low[k] + span[k] v
    / 255.
    """
    nx, ny, _ = run.model.grid.dims
    ids = run.model.cloud.ids.get().astype(np.int64)
    rows = np.zeros(len(ids), POINT)
    rows["vertex"] = np.stack([ids % nx, ids // nx % ny, ids // (nx * ny)], 1)
    rows["opacity"] = np.rint(run.model.cloud.opacity.get() * 65535)
    by_function = coefficients.transpose(1, 0, 2).reshape(COUNT, -1)
    low, high = np.quantile(by_function, [OUTLIERS, 1 - OUTLIERS], axis=1).astype(np.float32)
    span = np.maximum(high - low, np.float32(1e-6))
    scaled = (coefficients - low[:, None]) / span[:, None] * 255
    rows["colour"][:, : 3 * COUNT] = np.rint(scaled.clip(0, 255)).reshape(len(ids), -1)
    return rows, low, span


def page_text(run: Run) -> str:
    """The page. Raises UserError as check_drawable does."""
    check_drawable(run)
    rows, low, span = pack(run, fit_harmonics(run))
    folder = Path(__file__).parent
    page = (folder / "page.html").read_text("utf-8")
    name = run.folder.path.resolve().name  # which may be no UTF-8
    parts = {
        "title": html.escape(os.fsencode(name).decode(errors="replace")),
        "header": json.dumps(_header(run, low, span)).replace("<", "\\u003c"),
        "points": base64.b64encode(rows.tobytes()).decode(),
        "script": (folder / "page.js").read_text("utf-8"),
    }
    for name, text in parts.items():
        page = page.replace(f"<!-- {name} -->", text)
    return page


def check_drawable(run: Run) -> None:
    """Raise UserError unless the run's points are composited by alpha, with soft footprints: the
    page draws no others.
    """
    raster = run.config.raster
    if (raster.blend, raster.footprint) != ("alpha", "soft"):
        raise UserError(
            f"{run.folder.config}: raster.blend {raster.blend} with raster.footprint"
            f" {raster.footprint} cannot be drawn by the page, only alpha with soft; choose another"
            " --format"
        )


def _header(run, low, span):
    """What the page must know beside the points."""
    grid = run.model.grid
    centre, radius = run.ball
    cameras = run.cameras("train")
    poses = np.stack([camera.pose for camera in cameras])
    up = -poses[:, :, 1].mean(0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    eye = centre + _first_offset(poses[0, :, 3] - centre, up) * radius
    return {
        "count": run.model.cloud.count,
        "stride": POINT.itemsize,
        "origin": [float(x) for x in grid.origin],
        "edge": float(grid.edge),
        "radius": float(run.config.raster.radius * grid.edge),
        "nearest": float(NEAREST * radius),
        "centre": centre.tolist(),
        "pixel": min(_pixel_width(camera, centre) for camera in cameras),
        "low": low.tolist(),
        "span": span.tolist(),
        "eye": eye.tolist(),
        "up": up.tolist(),
        "fov": FIELD_OF_VIEW,
    }


def _pixel_width(camera, centre):
    """Of a camera's pixel, in world units at the distance of the centre."""
    return float(np.linalg.norm(camera.eye - centre)) / min(camera.fx, camera.fy)


def _first_offset(towards, up):
    """Where the page's first eye is from the centre, in radii: at the side of the first training
    view, 20 degrees above the horizon, at a distance from which the page shows the whole ball.
    """
    level = towards - towards @ up * up
    if np.linalg.norm(level) < 1e-6:
        level = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    level /= np.linalg.norm(level)
    rise = np.radians(20)
    distance = 1 / np.sin(np.radians(FIELD_OF_VIEW) / 2)
    return distance * (np.cos(rise) * level + np.sin(rise) * up)
