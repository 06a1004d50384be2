"""Masks that contradict those of the other views."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pp_cl.scene.bounds import mask_votes
from pp_cl.scene.grid import Grid
from pp_cl.scene.views import View

# A view is told of if it alone rejects more than this share of the object, and several times what
# is usual: every view carves a little that no other does, the more so where there are few. Lego's
# views reach 0.03 with all 100 of them, and 0.15 with 20; a mask shifted by 15 % of the image 0.35.
LEAST_SHARE, TIMES_MEDIAN, TIMES_EVEN = 0.05, 4.0, 4.0
AGREEING = 0.75  # of the other views that see a place, whose masks hold it


class Disagreement(NamedTuple):
    """A view whose mask rejects what the others agree on. share: of the places that they agree on,
    which it alone rejects; those are the vertices `ids` (M,) of a coarse grid.
    """

    view: View
    share: float
    grid: Grid
    ids: np.ndarray


def disagreements(views: Sequence[View], box: np.ndarray) -> list[Disagreement]:
    """The views whose masks disagree with the others, the worst first.

    box: (2, 3), around the hull; its double is searched, since a wrong mask has carved it.
    """
    if not all(view.has_mask for view in views):
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
    return [Disagreement(views[i], float(shares[i]), grid, np.flatnonzero(alone[i])) for i in worst]
