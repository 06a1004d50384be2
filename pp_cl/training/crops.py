"""How large the crop of a training step is, and where it lies along one axis."""

import numpy as np

BOX_MARGIN = 8  # pixels around the object from which crops are drawn
CROP_LOSS = 0.25  # of the crop's side for every halving of the images
END_SHARE = 0.25  # of the crops that show one end of the object, at least


def crop_side(side: int, halvings: int) -> int:
    """The setting train.crop, for images halved this many times: whole quads of pixels."""
    return 4 * round(side * (1 - CROP_LOSS * halvings) / 4)


def draw_start(rng: np.random.Generator, low: int, high: int, size: int, *, limit: int) -> int:
    """First pixel of a crop of `size` that shows a part of [low, high) as large as possible, inside
    [0, limit).

    The object's two ends are each in a share END_SHARE of the crops if not in more: uniform draws
    hardly ever show the ends of what is much wider than a crop.
    """
    first, last = sorted((low, high - size))
    first, last = max(first, 0), max(min(last, limit - size), 0)
    start = int(rng.integers(first, last + 1))
    end, inside = rng.random(), int(rng.integers(BOX_MARGIN + 1))
    uniform = min((BOX_MARGIN + 1) / (last - first + 1), END_SHARE)
    drawn = (END_SHARE - uniform) / (1 - 2 * uniform)
    if high - low > size and end < drawn:
        start = min(first + inside, last)
    elif high - low > size and end > 1 - drawn:
        start = max(last - inside, first)
    return start
