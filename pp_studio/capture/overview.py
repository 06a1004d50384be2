"""Draws a scene from the side and from above: its points, its cameras and the object's box."""

import itertools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from pp_cl import Camera
from pp_cl.scene import up_of
from pp_studio.capture.box import corners_of

FINER = 2  # the drawing is this many times larger before it is reduced, against jagged lines
MARGIN = 0.08  # of a panel's width, around its content
FRUSTUM = 0.12  # depth of a frustum, in median distances of the cameras from their middle
CAMERA, BOX, INK = (40, 90, 200), (220, 90, 0), (60, 60, 60)
MOST_POINTS = 100_000  # that are drawn
EDGES = [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1]


def overview(
    cameras: Sequence[Camera],
    box: np.ndarray | None,
    points: np.ndarray,
    colours: np.ndarray,
    width: int,
) -> np.ndarray:
    """uint8 (width // 2, width, 3): the scene from the side and from above, over white.

    box: (2, 3) in world units, or None. points: (N, 3); colours: (N, 3) uint8. Points far beyond
    the cameras are cut off.
    """
    up, eyes = up_of(cameras), np.stack([camera.eye for camera in cameras])
    aside = np.cross(cameras[0].pose[:, 2], up)
    if np.linalg.norm(aside) < 1e-6:  # the camera looks straight down
        aside = cameras[0].pose[:, 0] - (cameras[0].pose[:, 0] @ up) * up
    aside /= np.linalg.norm(aside)
    corners = np.empty((0, 3)) if box is None else corners_of(box)
    length = FRUSTUM * (np.median(np.linalg.norm(eyes - eyes.mean(0), axis=1)) or 1.0)
    pyramids = []  # (5, 3) each: eye and image corners of a camera
    for c in cameras:
        wide, high = np.array([0, c.width, c.width, 0]), np.array([0, 0, c.height, c.height])
        rays = np.stack([(wide - c.cx) / c.fx, (high - c.cy) / c.fy, np.ones(4)], axis=1)
        pyramids.append(np.concatenate([[c.eye], c.eye + length * rays @ c.pose[:, :3].T]))
    frusta = np.array(pyramids)
    step = max(1, len(points) // MOST_POINTS)
    panels = []
    for title, down in (("from the side", -up), ("from above", np.cross(aside, up))):
        axes, side = np.stack([aside, down], axis=1), FINER * (width // 2)
        shown = np.concatenate([frusta.reshape(-1, 3), corners]) @ axes
        low, high = shown.min(0), shown.max(0)
        scale = side * (1 - 2 * MARGIN) / max(float((high - low).max()), 1e-30)
        offset = side / 2 - scale * (low + high) / 2

        def place(positions, axes=axes, scale=scale, offset=offset):
            return scale * (positions @ axes) + offset

        dots = np.full((side, side, 3), 255, np.uint8)  # a dot takes FINER x FINER pixels
        for dx, dy in itertools.product(range(FINER), repeat=2):
            x, y = np.floor(place(points[::step])).T + [[dx], [dy]]
            inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
            dots[y[inside].astype(int), x[inside].astype(int)] = colours[::step][inside]
        image = Image.fromarray(dots)
        draw = ImageDraw.Draw(image)
        for frustum in place(frusta):
            eye, *ends = map(tuple, frustum)
            for i, end in enumerate(ends):
                draw.line([eye, end, ends[(i + 1) % 4]], CAMERA, FINER)
        lines = place(corners)
        for a, b in EDGES if len(corners) else ():
            draw.line([tuple(lines[a]), tuple(lines[b])], BOX, 2 * FINER)
        image = image.resize((width // 2, width // 2), Image.Resampling.BOX)
        ImageDraw.Draw(image).text((4, 2), title, fill=INK)
        panels.append(np.array(image))
    return np.concatenate(panels, axis=1)
