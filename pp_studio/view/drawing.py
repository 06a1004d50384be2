"""Draws what a run shows to a camera as 8-bit images: colours, depth, normals, or a photograph."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pp_cl import Camera, Run
from pp_cl.engine import Target, View
from pp_cl.errors import UserError
from pp_cl.files import linear_to_srgb, srgb_to_linear, to_8bit
from pp_studio.large import render_large

SHOWN = ("colour", "alpha", "depth", "normals", "fragments", "error", "photograph")
OWN_CAMERA = SHOWN[5:]  # shown from the nearest training view's own camera
ERROR_SCALE = 4  # errors are multiplied by this
DARK = np.array([23, 24, 27]) / 255  # sRGB of empty pixels
LEAST_ALPHA = 0.5  # least alpha of a pixel whose depth is used: below it, edge and background mix
# eleven colours of viridis, from low to high (matplotlib, CC0)
VIRIDIS = (
    "440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725"  # each RRGGBB
)
COLOURS = np.array([list(bytes.fromhex(word)) for word in VIRIDIS.split()]) / 255


def draw(
    run: Run,
    views: list[View],
    camera: Camera,
    show: str = "colour",
    *,
    early_stop: float | None = None,
    share: float = 1.0,
    exposure: float = 0.0,
    on_part: Callable[[], object] = lambda: None,
) -> tuple[np.ndarray, str]:
    """((H, W, 3) uint8, a line on it). views: the run's training views, none if its photographs are
    gone. show: one of SHOWN. early_stop: replaces raster.early_stop. share: of the most opaque
    points, in (0, 1]. exposure: in stops. on_part: called before each part of the work. Raises
    UserError if there is no photograph to show, or if the model computes NaN.
    """
    truth, line = np.empty(0), ""
    if show in OWN_CAMERA:
        if not views:
            raise UserError("the photographs are not there")
        view = views[nearest_view([photograph.camera for photograph in views], camera, run.ball[0])]
        camera, line, truth = view.camera, view.name, Target(run.dev).whole(view)
    run = most_opaque(run, share) if share < 1 else run
    if show == "photograph":
        image = to_8bit(truth)
    elif show == "fragments":
        # the whole view: until="weights" would change buffers with which a training goes on
        between = run.depth_range(camera)
        whole = run.renderer.forward(camera, run.gamma, early_stop=early_stop, depth_range=between)
        counts, _ = whole.fragments()
        image = colour_scale(counts, 0, counts.max(), counts > 0)
        line = f"0 to {counts.max()} fragments"
    else:
        rendered = render_large(run, camera, early_stop=early_stop, on_part=on_part)
        is_known = rendered.alpha >= LEAST_ALPHA
        if show == "alpha":
            image = to_8bit(np.repeat(rendered.alpha[..., None], 3, axis=2))
        elif show == "depth":
            centre, radius = run.ball
            middle = (centre - camera.eye) @ camera.pose[:, 2]
            low, high = max(middle - radius, 0.0), max(middle + radius, 0.0)
            image, line = (
                colour_scale(rendered.depth, low, high, is_known),
                f"{low:.3g} to {high:.3g}",
            )
        elif show == "normals":
            normals = normals_from_depth(np.where(is_known, rendered.depth, np.nan), camera)
            image = to_8bit(np.where(np.isnan(normals), DARK, (normals + 1) / 2))
        elif show == "error":
            image = to_8bit(ERROR_SCALE * np.abs(rendered.colour - truth))
            line += f", error x{ERROR_SCALE}"
        else:
            image = to_8bit(rendered.colour)
    if exposure:
        light = srgb_to_linear(np.arange(256) / 255) * 2.0**exposure
        image = to_8bit(linear_to_srgb(light))[image]
    return image, line


def nearest_view(cameras: list[Camera], camera: Camera, centre: np.ndarray) -> int:
    """Index of the camera nearest to another: by the distance of the eyes, plus the angle between
    the axes times the eye's distance from the object's centre (3,).
    """
    radius = np.linalg.norm(camera.eye - centre)
    apart = [np.linalg.norm(other.eye - camera.eye) for other in cameras]
    turned = [np.arccos(np.clip(c.pose[:, 2] @ camera.pose[:, 2], -1, 1)) for c in cameras]
    return int(np.argmin(np.array(apart) + radius * np.array(turned)))


def most_opaque(run: Run, share: float) -> Run:
    """The run, and each of its members, with only a share of its points, in (0, 1]: the most opaque
    ones, at least one.
    """
    opacity = run.model.cloud.opacity.get()[:, 0]
    count = max(1, round(share * len(opacity)))
    keep = np.sort(np.argsort(-opacity, kind="stable")[:count]).astype(np.uint32)
    return run.varied(rows=keep, others=[most_opaque(other, share) for other in run.others])


def colour_scale(values: Any, low: float, high: float, is_known: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: viridis from low to high, DARK where a value of (H, W) is not known."""
    place = (np.where(is_known, values, low) - low) / max(high - low, 1e-12)
    stops = np.linspace(0, 1, len(COLOURS))
    image = np.stack([np.interp(place, stops, COLOURS[:, i]) for i in range(3)], axis=2)
    return to_8bit(np.where(is_known[..., None], image, DARK))


def normals_from_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W, 3) float64 unit normals in world axes, towards the camera, of the surface in a depth
    map (H, W) along the camera's axis; NaN where a pixel or a needed neighbour has no depth. Of two
    neighbours, the one with the nearer depth is used, so that edges stay sharp.
    """
    positions = depth[..., None] * (camera.rays() @ camera.pose[:, :3])

    def along(axis):
        steps = np.diff(positions, axis=axis, append=np.nan)
        before = np.roll(steps, 1, axis)  # the NaN comes first here
        ahead_jump, before_jump = (np.abs(step[..., 2:]) for step in (steps, before))
        return np.where(np.isnan(before_jump) | (ahead_jump <= before_jump), steps, before)

    normals = np.cross(along(0), along(1))  # x right, y down: their product points at the camera
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return normals @ camera.pose[:, :3].T
