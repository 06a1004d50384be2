"""Finds masks that contradict those of the other views, and writes the warning."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pp_cl.engine.grid import Grid, smallest_voxel_size
from pp_cl.engine.views import MASK_THRESHOLD, View
from pp_cl.errors import few_names

# pp-cl warns about a view if it alone rejects more than this share of the object and several times
# the usual share. Each view carves away a little that no other view does, and more if there are
# few: lego's views reach 0.03 with all 100 of them and 0.15 with 20, and a mask shifted by 15 % of
# the image reaches 0.35.
LEAST_SHARE, TIMES_MEDIAN, TIMES_EVEN = 0.05, 4.0, 4.0
PROBED_CELLS = 32**3  # positions at which the masks are looked up
AGREEING = 0.75  # share of the other views seeing a place whose masks must contain it


class Disagreement(NamedTuple):
    """A view whose mask alone rejects a share of the places that the others agree on. ids: (M,) the
    rejected places, as vertices of the coarse grid.
    """

    view: View
    share: float
    grid: Grid
    ids: np.ndarray


def disagreements(views: Sequence[View], box: np.ndarray) -> list[Disagreement]:
    """The views whose masks disagree with the others, the worst first. box: (2, 3), around the
    hull; a box twice as large is searched, since a wrong mask has shrunk the hull.
    """
    if not any(view.has_mask for view in views):
        return []
    middle, reach = box.mean(0), np.ptp(box, axis=0)
    grid, on_mask, beside = mask_votes(views, np.stack([middle - reach, middle + reach]))
    rejections, holding = beside.sum(0), on_mask.sum(0)
    agreed = holding >= np.maximum(AGREEING * (holding + rejections - 1), 1)
    alone = beside & (rejections == 1) & agreed
    inside = int(((rejections == 0) & agreed).sum())
    shares = alone.sum(1) / np.maximum(inside + alone.sum(1), 1)
    least = max(LEAST_SHARE, TIMES_MEDIAN * float(np.median(shares)), TIMES_EVEN / len(views))
    worst = [i for i in np.argsort(-shares, kind="stable") if shares[i] > least]
    alone = alone.reshape(-1, *grid.dims[::-1])
    return [Disagreement(views[i], float(shares[i]), grid, grid.ids_of(alone[i])) for i in worst]


def explain_empty_hull(views: Sequence[View], box: np.ndarray) -> str:
    """One line that says which masks contradict the most others, so that a (2, 3) box has no point
    left.
    """
    _, on_mask, beside = mask_votes(views, box)
    agreeing = on_mask.sum(0).max()
    objections = beside[:, on_mask.sum(0) == agreeing].mean(1)
    names = [views[i].name for i in np.argsort(-objections, kind="stable") if objections[i] > 0]
    if agreeing >= 0.75 * len(views) and names:
        return (
            f"{few_names(names)}: the mask rejects every place that the other views agree on: check"
            " its alpha and its camera"
        )
    return (
        f"{few_names([view.name for view in views])}: the masks leave no point, as at most"
        f" {agreeing} of {len(views)} meet in one place:"
        " check the masks and the camera poses (camera-to-world; in transforms files x right, y"
        " up, z backward)"
    )


def mask_votes(views: Sequence[View], box: np.ndarray) -> tuple[Grid, np.ndarray, np.ndarray]:
    """(a grid of about 32^3 vertices in a (2, 3) box, (V, N) bool: the vertices of its lattice()
    that each view's mask covers, (V, N) bool: the vertices that its image shows beside the mask).
    """
    grid = Grid.centred_in(box, smallest_voxel_size(box, PROBED_CELLS))
    vertices = grid.lattice()
    on_mask, beside = [], []
    for view in views:
        column, row, is_shown = view.stored_camera.pixels(vertices)
        is_on = view.image[row, column, 3] > MASK_THRESHOLD
        if view.ignored is not None:
            is_shown &= ~view.ignored[row, column]
        on_mask.append(is_shown & is_on)
        beside.append(is_shown & ~is_on)
    return grid, np.stack(on_mask), np.stack(beside)
