"""Writes runs as HTML files drawn with WebGL2, without the network; and a gallery of them."""

import base64
import html
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Camera, Run
from pp_cl.files import atomic_folder, to_8bit, write_png, write_text
from pp_cl.scene import up_of
from pp_studio.camera_path import level
from pp_studio.export.gaussians import Gaussians, fitted_gaussians
from pp_studio.export.harmonics import COUNT
from pp_studio.large import render_large

# The bytes of a Gaussian: place in the box of all Gaussians; opacity; logarithms of its deviations;
# x, y and z of the quaternion that turns its axes, swapped to make w largest, so that x, y and z
# lie within TURNED; coefficients of its colours, in the order of Gaussians.
PACKED = np.dtype(
    [
        ("place", "<u2", 3),
        ("opacity", "u1"),
        ("deviations", "u1", 3),
        ("turn", "u1", 3),
        ("colour", "u1", 27),
    ]
)
OUTLIERS = 1e-3  # share of values clipped at each end, as outliers would coarsen all others
PLACES, TURNED = np.iinfo(np.uint16).max, 240
FIELD_OF_VIEW = 40.0  # degrees across the shorter side of the page
RISE = 20.0  # degrees
FILLED = 0.8  # share of the shorter side that the turning object fills; lines of text are above it
SAMPLED_POINTS = 20_000
NEAREST = 0.05  # in radii of the object: anything nearer to the eye is not drawn, as in a run
SECTORS, BESIDE = 36, 45.0  # azimuths, and degrees to each side that a photograph covers
STILL = 600, 315  # pixels: the least size that programs show large beside a link
HERE = Path(__file__).parent


def pack(table: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """Records of GAUSSIAN as (N,) rows of PACKED, as the page stores them, and how to decode their
    bytes: a place is corner + unit times the number; byte v of coefficient k is low[k] +
    span[k] v / 255; of a deviation, the exponential of logarithms[0] + logarithms[1] v / 255.
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
    """(deviations (N, 3), bytes (N, 3) of their axes), swapped so that the axes turn least."""
    ways = Rotation.create_group("O")
    own = Rotation.from_quat(np.roll(turn, -1, axis=1))
    # w of the product of two quaternions (x, y, z, w)
    quaternions, others = own.as_quat(), ways.as_quat() * [-1, -1, -1, 1]
    chosen = np.argmax(np.abs(quaternions @ others.T), axis=1)
    turned = (own * ways[chosen]).as_quat(canonical=True)
    swapped = np.abs(ways.as_matrix())[chosen]
    kept = np.einsum("nji,nj->ni", swapped, deviations)
    return kept, np.rint(turned[:, :3] * TURNED + 128).astype(np.uint8)


def pack_specular(parameters: dict[str, np.ndarray] | None) -> str:
    """The specular layer of Gaussians as base64 of float32, or "" without one: of each of its three
    convolutions the biases, then for each input the weights of all outputs. Inputs 3 to 15, which
    are equal in an image of Gaussians, are summed into one.
    """
    if not parameters:
        return ""
    parts: list[np.ndarray] = []
    for name in "abc":
        weight, bias = parameters[f"{name}.weight"][:, 0, 0], parameters[f"{name}.bias"]
        rows = weight.transpose(1, 0, 2).reshape(weight.shape[1], -1)
        if name == "a":
            rows = np.concatenate([rows[:3], rows[3:16].sum(0, keepdims=True), rows[16:]])
        count = 4 if name == "c" else len(bias)
        parts += [bias[:count], rows[:, :count].ravel()]
    return base64.b64encode(np.concatenate(parts).astype("<f4").tobytes()).decode()


def page_text(gaussians: Gaussians, cameras: Sequence[Camera], title: str, still: str = "") -> str:
    """The HTML of the page. cameras: those of the training. still: the file of an image that stands
    for the page in links, "" for none.
    """
    rows, about = pack(gaussians.table)
    data, corner = base64.b64encode(rows.tobytes()).decode(), about.pop("corner")
    places = gaussians.table["position"].astype(np.float64)
    # a few Gaussians may have gone astray
    low, high = np.quantile(places, [OUTLIERS, 1 - OUTLIERS], axis=0) + gaussians.origin
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    eye, up = first_look(places + gaussians.origin, centre, cameras)
    # width of a training pixel at the middle of the object
    pixels = [np.linalg.norm(camera.eye - centre) / min(camera.fx, camera.fy) for camera in cameras]
    header = about | {
        "count": len(rows),
        "origin": (gaussians.origin + corner).tolist(),
        "corner": corner,
        "extent": gaussians.extent,
        "specular": pack_specular(gaussians.specular),
        "nearest": NEAREST * radius,
        "centre": centre.tolist(),
        "pixel": float(np.median(pixels)),
        "windows": gaussians.windows,
        "low_pass": gaussians.low_pass,
        "eye": eye.tolist(),
        "up": up.tolist(),
        "fov": FIELD_OF_VIEW,
        "ahead": level(eye - centre, up).tolist(),
        "photographed": photographed(cameras, centre, up, level(eye - centre, up)),
    }
    parts = {
        "title": html.escape(title),
        "header": json.dumps(header).replace("<", "\\u003c"),
        "gaussians": data,
        "script": (HERE / "page.js").read_text("utf-8"),
    }
    return filled("page.html", parts, still)


def photographed(
    cameras: Sequence[Camera], centre: np.ndarray, up: np.ndarray, ahead: np.ndarray
) -> list[list[int]]:
    """From where an object was photographed: for each of SECTORS azimuths around `up`, counted from
    `ahead` by the right-hand rule, [lowest elevation, highest elevation, degrees beyond BESIDE to
    the nearest camera's azimuth], in whole degrees.
    """
    offsets = np.stack([camera.eye - centre for camera in cameras])
    height, across = offsets @ up, offsets @ np.stack([ahead, np.cross(up, ahead)], axis=1)
    elevations = np.degrees(np.arctan2(height, np.linalg.norm(across, axis=1)))
    azimuths = np.degrees(np.arctan2(across[:, 1], across[:, 0]))
    sectors = []
    for sector in range(SECTORS):
        apart = np.abs((azimuths - sector * 360 / SECTORS + 180) % 360 - 180)
        near = apart <= max(apart.min(), BESIDE)
        aside = max(0.0, apart.min() - BESIDE)
        row = (elevations[near].min(), elevations[near].max(), aside)
        sectors.append([round(float(value)) for value in row])
    return sectors


def filled(template: str, parts: dict[str, str], still: str) -> str:
    """Fill a template of this folder with its parts, {name: text}. still: the image that programs
    show beside a link to the page, "" for none.
    """
    large = '<meta name="twitter:card" content="summary_large_image">'
    card = f'<meta property="og:image" content="{still}">\n{large}' if still else ""
    page = (HERE / template).read_text("utf-8")
    for name, text in ({"card": card} | parts).items():
        page = page.replace(f"<!-- {name} -->", text)
    return page


def write_gallery(folder: Path, runs: Iterable[Run]) -> int:
    """Write a page and a still of each run into a folder, with an index of them; returns the number
    of runs. Raises UserError as fitted_gaussians and atomic_folder do.
    """
    stems: list[str] = []
    figures = []
    with atomic_folder(folder) as unfinished:
        for run in runs:
            name = run.folder.name
            stem = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-") or "run"
            while stem.lower() in {"index", *map(str.lower, stems)}:  # some disks ignore case
                stem += "-2"
            stems.append(stem)
            page = page_text(fitted_gaussians(run), run.cameras("train"), name, f"{stem}.png")
            write_text(unfinished / f"{stem}.html", page)
            write_png(unfinished / f"{stem}.png", still(run))
            image = f'<img src="{stem}.png" alt="">'
            figures.append(f'<a href="{stem}.html">{image}{html.escape(name)}</a>')
        page = filled("gallery.html", {"figures": "\n".join(figures)}, f"{stems[0]}.png")
        write_text(unfinished / "index.html", page)
    return len(stems)


def still(run: Run) -> np.ndarray:
    """(H, W, 3) uint8: the first view of the run's page, in the size STILL."""
    look = run.model.positions(), run.ball[0], run.cameras("train")
    (eye, up), (width, height) = first_look(*look), STILL
    focal = height / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    camera = Camera.look_at(eye, run.ball[0], up, fx=focal, width=width, height=height)
    return to_8bit(render_large(run, camera).colour)


def first_look(
    points: np.ndarray, centre: np.ndarray, cameras: Sequence[Camera]
) -> tuple[np.ndarray, np.ndarray]:
    """(eye, up), both (3,), of a page's first view: it looks at the centre of the points (N, 3)
    from the side of the first camera, RISE above the horizon, or as near to that as cameras were,
    and shows the whole object, also while it turns.
    """
    up, offsets = up_of(cameras), np.stack([camera.eye - centre for camera in cameras])
    elevations = np.arcsin(offsets @ up / np.linalg.norm(offsets, axis=1))
    rise = np.clip(np.radians(RISE), elevations.min(), elevations.max())
    ahead = level(cameras[0].eye - centre, up)
    points = points[:: max(1, len(points) // SAMPLED_POINTS)] - centre
    half, distance = FILLED * np.tan(np.radians(FIELD_OF_VIEW) / 2), 0.0
    for angle in np.radians(range(0, 360, 15)):
        side = np.cos(angle) * ahead + np.sin(angle) * np.cross(up, ahead)
        towards = np.cos(rise) * side + np.sin(rise) * up
        right = np.cross(up, side)
        across = np.abs(points @ np.stack([right, np.cross(towards, right)], axis=1)).max(axis=1)
        distance = max(distance, float((across / half + points @ towards).max()))
    return centre + distance * (np.cos(rise) * ahead + np.sin(rise) * up), up
