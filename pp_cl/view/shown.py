"""Turns depth, normals, hits and errors of a view into 8-bit images; DARK without an object."""

import io

import numpy as np
from PIL import Image

from pp_cl.files.contact_sheet import ERROR_GAIN
from pp_cl.files.exr import linear_to_srgb, srgb_to_linear
from pp_cl.files.image import to_8bit
from pp_cl.scene.camera import Camera

DARK = np.array([23, 24, 27]) / 255  # sRGB, the background of page.css
LEAST_ALPHA = 0.5  # of a pixel that has a depth to look at: those below mix edge and background
JPEG_QUALITY = 90
# eleven colours of viridis, from low to high (matplotlib, CC0)
VIRIDIS = (
    "440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725"  # each RRGGBB
)
COLOURS = np.array([list(bytes.fromhex(word)) for word in VIRIDIS.split()]) / 255


def colour_scale(values: np.ndarray, low: float, high: float, known: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: viridis from low to high. values: (H, W); known: (H, W) bool, the pixels
    that have a value.
    """
    place = (np.where(known, values, low) - low) / max(high - low, 1e-12)
    stops = np.linspace(0, 1, len(COLOURS))
    image = np.stack([np.interp(place, stops, COLOURS[:, i]) for i in range(3)], axis=2)
    return to_8bit(np.where(known[..., None], image, DARK))


def grey(values: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of (H, W) values in [0, 1]."""
    return to_8bit(np.repeat(values[..., None], 3, axis=2))


def normals_from_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W, 3) float64 unit normals in world axes, towards the camera, of the surface that a depth
    map shows; NaN where a pixel or a neighbour that is needed has none.

    depth: (H, W) along the camera's axis, world units; infinite or NaN: none. Of the two neighbours
    in each direction the one of the nearer depth is taken, so that edges stay sharp.
    """
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    positions = depth[..., None] * (camera.rays() @ camera.pose[:, :3])
    along_x, along_y = _difference(positions, axis=1), _difference(positions, axis=0)
    normals = np.cross(along_y, along_x)  # x right, y down: their product points at the camera
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return normals @ camera.pose[:, :3].T


def _difference(positions, axis):
    """To the next position along the axis or from the previous one, whichever depth is nearer."""
    steps = np.diff(positions, axis=axis)
    edge = np.full_like(np.take(positions, [0], axis), np.nan)
    ahead, behind = (np.concatenate(parts, axis) for parts in ((steps, edge), (edge, steps)))
    jump_ahead, jump_behind = (np.abs(step[..., 2:]) for step in (ahead, behind))
    return np.where(np.isnan(jump_behind) | (jump_ahead <= jump_behind), ahead, behind)


def normal_colours(normals: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: x, y and z from -1 to 1 as red, green and blue; NaN: no surface."""
    return to_8bit(np.where(np.isnan(normals), DARK, (normals + 1) / 2))


def error_image(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: |image - truth| of (H, W, 3) in [0, 1], ERROR_GAIN times."""
    return to_8bit(ERROR_GAIN * np.abs(image - truth))


def exposed(image: np.ndarray, stops: float) -> np.ndarray:
    """The uint8 image with 2^stops times as much light; sRGB, clipped."""
    light = srgb_to_linear(np.arange(256) / 255) * 2.0**stops
    return to_8bit(linear_to_srgb(light))[image]


def encoded(image: np.ndarray, lossless: bool) -> bytes:
    """The (H, W, 3) uint8 image as a PNG file, or a JPEG file where it need not be lossless."""
    file = io.BytesIO()
    kind = {"format": "PNG"} if lossless else {"format": "JPEG", "quality": JPEG_QUALITY}
    Image.fromarray(image).save(file, **kind)
    return file.getvalue()
