"""A bounding box of the object, from cameras and masks."""

import math
from collections.abc import Sequence

import numpy as np

from pp_cl.engine.views import MASK_THRESHOLD, View
from pp_cl.errors import UserError
from pp_cl.scene.agreement import explain_empty_hull

# how far, in image sizes, an object that the image border cuts off may reach beyond the border
CROPPED_MARGIN = 0.5
# sizes of the eyes' box that float32 can compute with, world units (docs/scenes.md)
LEAST_REACH, MOST_REACH = 1e-12, 1e15
LEAST_SHARE = 1e-9  # a smaller share of a distance is rounding
SOLVED, INFEASIBLE = 0, 2  # status of scipy.optimize.linprog


def reach_of(views: Sequence[View]) -> float:
    """Longest side of the box around the cameras' eyes, world units. Raises UserError naming views
    if all cameras are in one place or too close together, or one is much too far away.
    """
    eyes = np.stack([view.camera.eye for view in views])
    reach, all_views = float(np.ptp(eyes, axis=0).max()), _all_of(views)
    if len(views) == 1:
        return reach
    if reach <= LEAST_SHARE * np.abs(eyes).max():
        place = ", ".join(f"{x:.6g}" for x in eyes[0])
        raise UserError(
            f"{all_views}: their cameras are all in one place, ({place}); give each frame its own"
            " pose"
        )
    if reach < LEAST_REACH:
        raise UserError(
            f"{all_views}: their cameras are within {reach:.3g} world units, but"
            f" float32 needs {LEAST_REACH:g} or more; scale their positions up"
        )
    if reach > MOST_REACH:
        distances = np.abs(eyes - np.median(eyes, axis=0)).max(1)
        raise UserError(
            f"{views[int(distances.argmax())].name}: its camera is {distances.max():.3g} world"
            f" units from the middle of the others, but float32 allows {MOST_REACH:g} at most;"
            " correct its pose, or scale all positions down"
        )
    return reach


def _all_of(views):
    return f"{views[0].name} and the {len(views) - 1} other training views"


def bounding_box(views: Sequence[View]) -> np.ndarray:
    """(2, 3) box around the intersection of the views' pyramids, found by linear programs. A view's
    pyramid runs from its eye through the rectangle around its mask. A side on which the mask
    reaches the image border does not bound the object, unless nothing else does: then the bound
    lies CROPPED_MARGIN image sizes outside. Raises UserError if the pyramids do not meet, do not
    end or meet in a point, and as reach_of() does.
    """
    from scipy.optimize import linprog  # takes long to import

    unit = 2.0 ** math.frexp(reach_of(views))[1]  # the solver's tolerances are absolute
    masked = any(view.has_mask for view in views)
    for margin in (None, CROPPED_MARGIN) if masked else (0.0, CROPPED_MARGIN):
        planes = np.concatenate([_silhouette_planes(view, margin) for view in views])
        # lower bounds of x, y, z, -x, -y, -z
        bounds = [
            linprog(axis, -planes[:, :3], -planes[:, 3] / unit, bounds=(None, None))
            for axis in (*np.eye(3), *-np.eye(3))
        ]
        if any(b.status == INFEASIBLE for b in bounds):
            eyes = np.stack([view.camera.eye for view in views])
            raise UserError(explain_empty_hull(views, eyes.mean(0) + unit * np.array([[-1], [1]])))
        if all(b.status == SOLVED for b in bounds):
            box = np.array([[unit], [-unit]]) * np.array([b.fun for b in bounds]).reshape(2, 3)
            if not np.ptp(box, axis=0).max() > LEAST_SHARE * unit:
                break
            return box
    raise UserError(f"{_all_of(views)} do not bound the object: it must be seen from several sides")


def _silhouette_planes(view, cropped_margin):
    """(P, 4) normals n and offsets o: n.x >= o holds for every x that projects into the rectangle
    around the mask. Sides at the image border are left out (cropped_margin None) or moved outwards
    by cropped_margin image sizes.
    """
    camera, mask = view.stored_camera, view.hull_alpha > MASK_THRESHOLD
    normals = []
    for axis, size, focal, centre in (
        (0, camera.width, camera.fx, camera.cx),
        (1, camera.height, camera.fy, camera.cy),
    ):
        used = np.flatnonzero(mask.any(axis))
        if not used.size:
            continue
        for sign, edge, border in ((1, used[0] - 1, 0), (-1, used[-1] + 2, size)):
            if sign * (edge - border) <= 0:
                if cropped_margin is None:
                    continue
                edge = border - sign * cropped_margin * size
            normal = np.array([0, 0, -(edge - centre) / focal])
            normal[axis] = 1
            normals.append(sign * camera.pose[:, :3] @ normal / np.linalg.norm(normal))
    normals = np.array(normals).reshape(-1, 3)
    return np.column_stack([normals, normals @ camera.eye])
