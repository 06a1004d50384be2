"""Float64 twins of the kernels that prepare a scene: the visual hull, undistortion, training
targets and the demo's object, built from segments and circles.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import BarycentricInterpolator
from scipy.ndimage import map_coordinates, maximum_filter

CENTRE = np.array([0, 0, 0.15])  # of the globe
MERIDIAN = np.array([0.819152, 0.573576, 0])
WHEEL = np.array([-0.242404, 0.346188, 0.906308])
WHEEL_V = np.cross(WHEEL, MERIDIAN)
ECLIPTIC = np.cos(np.pi / 3) * MERIDIAN + np.sin(np.pi / 3) * WHEEL_V


def dilated_mask(alpha: np.ndarray, threshold: int, margin: int) -> np.ndarray:
    """(H, W) bool: a pixel within `margin` rows and columns has an alpha above the threshold."""
    return maximum_filter(alpha > threshold, 2 * margin + 1, mode="constant")


def in_hull(
    views: Sequence[Any],
    positions: np.ndarray,
    threshold: int,
    *,
    least: int,
    forgiven: int,
    doubts: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """((N,) bool: in the hull, as in scene.hull.Carver, (N,) distance in pixels to the nearest
    pixel border, over all views that have the position in front of them).
    """
    seeing, rejecting = np.zeros((2, len(positions)), int)
    border = np.full(len(positions), np.inf)
    for view in views:
        camera, mask = (
            view.stored_camera,
            dilated_mask(view.image[..., 3], threshold, 1 + view.downscale),
        )
        x, y, z = camera.pose[:, :3].T @ (positions - camera.eye).T
        front = np.flatnonzero(z > 0)
        x, y, z = x[front], y[front], z[front]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        away = np.minimum(np.abs(u - np.round(u)), np.abs(v - np.round(v)))
        border[front] = np.minimum(border[front], away)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        row, column = (
            np.clip(a, 0, n - 1).astype(int) for a, n in zip((v, u), mask.shape, strict=True)
        )
        doubting = front[~inside & ~mask[row, column]]
        front, u, v = front[inside], u[inside].astype(int), v[inside].astype(int)
        held = np.zeros(len(positions), bool)
        held[front] = mask[v, u]
        counted = np.zeros(len(positions), bool)
        counted[front] = True
        alpha = view.image[..., 3]
        if max(alpha[[0, -1]].max(), alpha[:, [0, -1]].max()) <= threshold:
            counted[:] = True  # the object ends within the image
            doubting = doubting[:0]
        seeing[doubting] -= doubts
        seeing += counted
        rejecting += counted & ~held
    return (seeing >= least) & (rejecting * len(views) <= forgiven * seeing), border


def undistorted(image: np.ndarray, camera: Any, lens: Any, factor: int = 1) -> np.ndarray:
    """(H // factor, W // factor, 4), from 0 to 255: a premultiplied image (H, W, 4) uint8, sampled
    by cubic splines where the lens puts the pixels of a pinhole camera, then reduced by area.
    """
    height, width = (side // factor for side in image.shape[:2])
    x = (np.arange(factor * width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(factor * height) + 0.5 - camera.cy) / camera.fy
    x, y = lens.apply(*np.meshgrid(x, y))
    places = [camera.fy * y + camera.cy - 0.5, camera.fx * x + camera.cx - 0.5]
    alpha = image[..., 3:] / 255.0
    planes = np.concatenate([image[..., :3] / 255.0 * alpha, alpha], axis=2)
    planes = np.stack(
        [map_coordinates(planes[..., i], places, order=3, mode="nearest") for i in range(4)]
    )
    planes /= np.maximum(planes[3], 1)  # overshoots near a mask's border keep their colour
    blocks = np.clip(planes, 0, 1).reshape(4, height, factor, width, factor)
    colour, alpha = np.split(blocks.mean((2, 4)).transpose(1, 2, 0), [3], axis=2)
    return 255 * np.concatenate([np.clip(colour / np.maximum(alpha, 1e-3), 0, 1), alpha], axis=2)


def target_forward(
    image: np.ndarray, downscale: int, left: int, top: int, *, width: int, height: int
) -> np.ndarray:
    """(height, width, 3): means of the blocks of an (H, W, 4) uint8 image over white."""
    colour, alpha = image[..., :3] / 255.0, image[..., 3:] / 255.0
    over_white = colour * alpha + (1 - alpha)
    target = np.ones((height, width, 3))
    for y in range(height):
        for x in range(width):
            rows, columns = (
                slice(max(first, 0), max(first + downscale, 0))
                for first in (top + downscale * y, left + downscale * x)
            )
            block = over_white[rows, columns]
            if block.size:
                target[y, x] = block.mean((0, 1))
    return target


def target_between(
    image: np.ndarray, left: float, top: float, *, width: int, height: int
) -> np.ndarray:
    """(height, width, 4): colour over white and alpha of a uint8 image, interpolated by the
    polynomial through the five nearest pixels on each axis; white and alpha 0 if the nearest pixel
    is outside.
    """
    alpha = image[..., 3:] / 255.0
    planes = np.concatenate([image[..., :3] / 255.0 * alpha + 1 - alpha, alpha], axis=2)
    target = np.empty((height, width, 4))
    for y, x in np.ndindex(height, width):
        column, row = round(left) + x, round(top) + y
        if not (0 <= column < image.shape[1] and 0 <= row < image.shape[0]):
            target[y, x] = 1, 1, 1, 0
            continue
        rows, columns = (np.arange(middle - 2, middle + 3) for middle in (row, column))
        near = planes[
            np.clip(rows, 0, image.shape[0] - 1)[:, None], np.clip(columns, 0, image.shape[1] - 1)
        ]
        lines = BarycentricInterpolator(rows, near)(top + y)
        target[y, x] = BarycentricInterpolator(columns, lines)(left + x)
    return np.clip(target, 0, 1)


def _segment(p, a, b):
    """(N,) distances of places (N, 3) to the segment from a to b."""
    share = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(p - a - share[:, None] * (b - a), axis=1)


def _circle(p, normal, radius):
    """(N,) distances of places (N, 3) to a circle around the origin."""
    height = p @ normal
    in_plane = np.linalg.norm(p - height[:, None] * normal, axis=1)
    return np.hypot(in_plane - radius, height)


def _rounded_rectangle(a, b, half, radius):
    """Signed distances of (a, b) to a rectangle enlarged by a radius."""
    u, v = np.abs(a) - half[0], np.abs(b) - half[1]
    outside = np.hypot(np.maximum(u, 0), np.maximum(v, 0))
    return np.where((u > 0) | (v > 0), outside, np.maximum(u, v)) - radius


def distance(positions: np.ndarray) -> np.ndarray:
    """(N,) signed distances of (N, 3) world positions to the object."""
    p = positions - CENTRE
    z = np.array([0, 0, 1.0])
    height = p @ MERIDIAN
    from_axis = np.hypot(p[:, 0], p[:, 1])
    in_band = np.linalg.norm(p - height[:, None] * MERIDIAN, axis=1)
    solids = [
        np.linalg.norm(p, axis=1) - 0.30,
        _rounded_rectangle(from_axis, p[:, 2] + 1.03, (0.50, 0.05), 0.03),
        _rounded_rectangle(in_band - 0.70, height, (0.018, 0.05), 0.006),
        np.linalg.norm(p + 0.88 * z, axis=1) - 0.07,
        _segment(p, -1.0 * z, -0.72 * z) - 0.03,
        _segment(p, -0.69 * WHEEL, 0.69 * WHEEL) - 0.014,
        _circle(p, WHEEL, 0.54) - 0.024,
        _circle(p, ECLIPTIC, 0.62) - 0.018,
    ]
    for angle in np.arange(12) * np.pi / 6:
        spoke = np.cos(angle) * MERIDIAN + np.sin(angle) * WHEEL_V
        solids.append(_segment(p, 0.2 * spoke, 0.54 * spoke) - 0.011)
    return np.min(solids, axis=0)
