"""Views of a ball, without files."""

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import View

CENTRE, RADIUS = np.array([-0.5, 1.3, 1.7]), 0.8
UP = (0.3, 0.2, 1)  # of all cameras, so that none is parallel to an axis


def ball_camera(eye, target, size=(64, 64), focal=1.5):
    """Camera at `eye` that looks at `target`; focal: in image widths."""
    width, height = size
    return Camera.look_at(eye, target, UP, fx=focal * width, width=width, height=height)


def ball_view(name, camera, centre=CENTRE, radius=RADIUS):
    """View of a ball: alpha is 255 if the ray through the pixel's centre meets the ball."""
    rays, to_centre = camera.rays(), centre - camera.eye
    along = rays @ to_centre
    hit = (along > 0) & (to_centre @ to_centre - along**2 / (rays**2).sum(-1) <= radius**2)
    return View(name, camera, np.where(hit, 255, 0)[..., None].repeat(4, -1).astype(np.uint8))


def ball_views(count=12, size=(64, 64), focal=1.5, distance=4.0):
    """Views of the ball from directions spread over the sphere."""
    n = np.arange(count)
    z, angle = 1 - (2 * n + 1) / count, n * np.pi * (3 - 5**0.5)
    directions = np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z]
    )
    cameras = [ball_camera(CENTRE + distance * d, CENTRE, size, focal) for d in directions]
    return [ball_view(f"train/r_{i}.png", camera) for i, camera in enumerate(cameras)]
