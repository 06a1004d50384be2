"""The box around the object that the masks allow, and why masks can leave no hull."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linprog

from pp_cl.errors import UserError
from pp_cl.scene.grid import Grid, smallest_edge
from pp_cl.scene.views import MASK_THRESHOLD, View

# how far, in image sizes, an object that the image border cuts off may reach beyond the border
CROPPED_MARGIN = 0.5
# of the box of the eyes, world units: what float32 computes with (docs/scenes.md)
LEAST_REACH, MOST_REACH = 1e-12, 1e15
LEAST_SHARE = 1e-9  # of a distance: less of it is rounding
SOLVED, INFEASIBLE = 0, 2  # status of scipy.optimize.linprog
PROBED_CELLS = 32**3  # positions at which an error's explanation looks up the masks
NAMES_SHOWN = 3  # views named in an error


def reach_of(views: Sequence[View]) -> float:
    """Longest side of the box of the cameras' eyes, world units. Raises UserError naming views
    where they make no scene: all are in one place, one is much too far away, or all are too close.
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
            f"{all_views}: their cameras are within {reach:.3g} world units, and"
            f" {LEAST_REACH:g} is the least that float32 computes with; scale their positions up"
        )
    if reach > MOST_REACH:
        distances = np.abs(eyes - np.median(eyes, axis=0)).max(1)
        raise UserError(
            f"{views[int(distances.argmax())].name}: its camera is {distances.max():.3g} world"
            f" units from the others' middle, and {MOST_REACH:g} is the most that float32 computes"
            " with; correct its pose, or scale all positions down"
        )
    return reach


def _all_of(views):
    return f"{views[0].name} and the {len(views) - 1} other training views"


def bounding_box(views: Sequence[View]) -> np.ndarray:
    """(2, 3) box around the intersection of one pyramid per view, the one through the rectangle
    around its mask, by linear programs.

    A side where the mask reaches the image border does not bound the object, unless nothing else
    does; then the object is taken to end CROPPED_MARGIN image sizes outside. Where no view has a
    mask, images end at their borders. Raises UserError when the pyramids do not meet, do not end or
    meet in a point, and as reach_of does.
    """
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
    """(P, 4) normals n and offsets o: n.x >= o holds for all x that the rectangle around the
    dilated mask lets pass.

    Sides where it reaches the image border: left out, or cropped_margin image sizes further out.
    """
    camera, mask = view.stored_camera, view.image[..., 3] > MASK_THRESHOLD
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


def explain_empty_hull(views: Sequence[View], box: np.ndarray) -> str:
    """One line on why the masks leave no point: which views contradict most others.

    It counts the masks that hold each of about 32^3 positions in a (2, 3) box.
    """
    empty = [view.name for view in views if view.image[..., 3].max() <= MASK_THRESHOLD]
    if empty:
        return (
            f"{listing(empty)}: the mask is empty (no alpha above {MASK_THRESHOLD}): mend or remove"
            " the image"
        )
    _, on_mask, beside = mask_votes(views, box)
    agreeing = on_mask.sum(0).max()
    objections = beside[:, on_mask.sum(0) == agreeing].mean(1)
    names = [views[i].name for i in np.argsort(-objections, kind="stable") if objections[i] > 0]
    if agreeing >= 0.75 * len(views) and names:
        return (
            f"{listing(names)}: the mask rejects every place that the other views agree on: check"
            " its alpha and its camera"
        )
    names = listing([view.name for view in views])
    return (
        f"{names}: the masks leave no point, at most {agreeing} of {len(views)} meet in one place:"
        " check the masks and the camera poses (camera-to-world; in transforms files x right, y"
        " up, z backward)"
    )


def mask_votes(views: Sequence[View], box: np.ndarray) -> tuple[Grid, np.ndarray, np.ndarray]:
    """(a grid of about 32^3 vertices in a (2, 3) box, (V, N) bool: which of its vertices fall onto
    each view's mask, and which into its image beside the mask).
    """
    grid = Grid.centred_in(box, smallest_edge(box, PROBED_CELLS))
    k, j, i = np.indices(grid.dims[::-1]).reshape(3, -1)
    vertices = np.stack([i, j, k, np.ones_like(i)])
    votes = [_votes_of(view, grid.projection(view.stored_camera) @ vertices) for view in views]
    return grid, *np.stack(votes, axis=1)


def _votes_of(view, projected):
    """(2, N) bool: which positions fall onto the mask, and which into the image beside it.

    projected: (3, N), as Grid.projection gives them.
    """
    u, v, depth = projected
    height, width = view.image.shape[:2]
    ahead = depth > 0
    x, y = (np.floor(np.divide(a, depth, where=ahead, out=np.full_like(a, -1))) for a in (u, v))
    inside = ahead & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    on = (
        view.image[np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int), 3]
        > MASK_THRESHOLD
    )
    return np.stack([inside & on, inside & ~on])


def listing(names: Sequence[str]) -> str:
    """A few of the names, and how many more there are."""
    return ", ".join(names[:NAMES_SHOWN]) + (
        f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    )
