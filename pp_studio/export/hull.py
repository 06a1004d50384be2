"""Makes what can be shown before a training: the visual hull of a scene's masks, coloured from its
photographs, as flat Gaussians on its surface.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from pp_cl import Camera, Progress, open_device, track
from pp_cl.config import scene_config
from pp_cl.engine import View, evenly
from pp_cl.scene import agreeing, build_grid, open_scene, scene_box, shrink
from pp_studio.export.gaussians import CONSTANT, GAUSSIAN, Gaussians

PRESET = "tiny"  # colours are read at its image size; a training begins with it, too
POINTS = 400_000  # in the hull and on its surface; some 50,000 are shown
SMOOTHING = 1.0  # standard deviation, in voxel sizes, of the Gaussian that smooths the surface
MOST_VIEWS = 48  # a colour is the median over at most this many views
FACING = 0.35  # least cosine between the normal and the direction to the eye for a view to count
OPAQUE = 250  # least alpha of pixels that contain no background
BEHIND = 3.0  # a point this many voxel sizes behind its pixel's nearest one is hidden
# Standard deviations, in voxel sizes, along and across the surface, and opacity: neighbours
# overlap, so that nothing shines through.
ALONG, ACROSS, OPACITY = 0.8, 0.2, 0.95
UNSEEN = 0.6  # grey of points that no view shows well


def hull_gaussians(
    scene: str, masks: str | None = None, device: str | None = None
) -> tuple[Gaussians, list[Camera]] | None:
    """(the coloured hull, the cameras of the photographs at their reduced size); None if there are
    no masks. scene, masks, device: as for `pp-cl train`. Raises UserError if the masks leave no
    hull.
    """
    dev = open_device(device)
    config = scene_config(scene, PRESET, [("scene.masks", masks, "--masks")] if masks else [])
    views, box = open_scene(dev, config, ("train",)).splits["train"], scene_box(config)
    if not any(view.has_mask for view in views):
        return None  # without masks, the hull is only a box
    with Progress("carving the visual hull"):
        views, _, forgiven = agreeing(dev, views, box)
        hull = build_grid(dev, views, POINTS, box, forgiven)
    inside = np.zeros(hull.grid.dims, np.float32)
    inside[tuple(hull.grid.coordinates(hull.ids).T)] = 1
    # empty cells around the hull, so that the surface is closed
    room = 3
    field = gaussian_filter(np.pad(inside, room), SMOOTHING)
    if field.max() <= 0.5:  # too thin for its voxels
        return None
    places, _, normals, _ = marching_cubes(field, 0.5)
    size = hull.grid.voxel_size
    positions = (places - room) * size + np.asarray(hull.grid.origin)
    colours = median_colours(evenly(views, MOST_VIEWS), positions, normals, size)
    table = np.zeros(len(positions), GAUSSIAN)
    table["position"] = positions - hull.grid.centre
    table["harmonics"][:, 0] = (colours - 0.5) / CONSTANT
    table["opacity"] = OPACITY
    table["deviations"] = size * np.array([ALONG, ALONG, ACROSS])
    table["turn"] = _turns(normals)
    return Gaussians(table, hull.grid.centre), [view.camera for view in views]


def median_colours(
    views: Sequence[View], positions: np.ndarray, normals: np.ndarray, spacing: float
) -> np.ndarray:
    """(N, 3) in [0, 1]: the median sRGB colour of points (N, 3) over the views that face their
    outward normals (N, 3) and in which nothing hides them. spacing: the distance between points.
    """
    samples = np.full((len(views), len(positions), 3), np.nan, np.float32)
    for colours, view in zip(samples, track(views, "colours of the hull", "view"), strict=True):
        camera, image = view.camera, shrink(view.image, view.downscale)
        depth = camera.project(positions)[2]
        towards = camera.eye - positions
        facing = (normals * towards).sum(1) > FACING * np.linalg.norm(towards, axis=1)
        column, row, is_shown = camera.pixels(positions)
        # the nearest depth in each cell; cells are about as wide as the points' spacing
        cell = max(1, int(np.ceil(1.5 * spacing * camera.fx / np.median(depth))))
        shape = -(-camera.height // cell), -(-camera.width // cell)
        at = row[is_shown] // cell, column[is_shown] // cell
        nearest = np.full(shape, np.inf)
        np.minimum.at(nearest, at, depth[is_shown])
        chosen = np.flatnonzero(is_shown)[depth[is_shown] < nearest[at] + BEHIND * spacing]
        chosen = chosen[facing[chosen]]
        pixels = image[row[chosen], column[chosen]]
        sure = pixels[:, 3] >= OPAQUE
        colours[chosen[sure]] = pixels[sure, :3] / np.float32(255)
    with Progress("medians of colours"):
        samples.sort(axis=0)  # NaN comes last; nanmedian() takes ten times as long
        count = (~np.isnan(samples[:, :, :1])).sum(axis=0, keepdims=True)
        middle = np.maximum([(count - 1) // 2, count // 2], 0)
        median = np.mean([np.take_along_axis(samples, at, axis=0)[0] for at in middle], axis=0)
        return np.where(count[0] > 0, median, np.float32(UNSEEN))


def _turns(normals):
    """(N, 4) unit quaternions (w, x, y, z) that turn z to the normals (N, 3)."""
    axis = np.stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(length[:, 0], normals[:, 2])[:, None]
    turn = Rotation.from_rotvec(axis / np.maximum(length, 1e-9) * angle)
    return np.roll(turn.as_quat(), 1, axis=1)
