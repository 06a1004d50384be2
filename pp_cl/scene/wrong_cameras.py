"""Finds the wrong cameras among right ones: by places along the rays of every mask and the views
that reject them or, without masks, by what the other images show of what a view shows.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import MASK_THRESHOLD, View, border, evenly

MOST = 1 / 8  # of the views may be wrong, rounded up; more are named, and the scene is refused
SIDE = 128  # pixels along the longer side of the masks that are compared, about
# rays through a mask, fewer in scenes of more than FULL views; places on each
RAYS, PLACES, FULL = 160, 64, 48
TOGETHER = 150  # views that are compared with each other at once
FEWEST = 8  # views among which one can be told to be wrong
AROUND, WIDER = 0.8, 1.3  # quantile of the objects' radii by view; factor for the searched ball
PAIRS = 600  # of views whose axes propose where the object is
# Two views contradict each other if one of them alone rejects this share of the other's mask: right
# ones reach 0.012 with contradictory masks.
CONTRADICTING = 0.05
# A view is silenced if the others' masks regain this share by that, and several times the usual
# one; it is wrong if its own mask lies beside the hull of the others, too.
LEAST_HARM, TIMES_HARM = 0.005, 6.0
LEAST_OWN, TIMES_OWN, USUAL = 0.02, 1.5, 0.9
MOST_HARM = 0.8  # an eye inside the object has nothing beside its hull
MOST_OWN, LEAST_SHOWN = 0.5, 0.5  # a cropped view that looks elsewhere
# Without masks: least share of the other images that show one place of a view's pyramid;
# bounds of an eye's distance to where most look, as shares of the usual one.
GRID, DEPTHS, LEAST_TOGETHER = 7, 16, 0.75
MANY = 48  # other images, at most
INSIDE, AT_IT, AWAY = 0.25, 0.08, 6.0


class _Small(NamedTuple):
    """A view reduced to about SIDE pixels. strict: (H, W) bool, surely the object. accepted: what
    its mask allows, widened by a pixel. is_whole: its mask ends within the image.
    """

    camera: Camera
    strict: np.ndarray
    accepted: np.ndarray
    is_whole: bool


def _small(view):
    reduced = view.near_size(SIDE)
    camera, k = reduced.camera, reduced.downscale
    alpha = view.hull_alpha[: camera.height * k, : camera.width * k]
    blocks = alpha.reshape(camera.height, k, camera.width, k).max((1, 3)) > MASK_THRESHOLD
    strict = view.image[: camera.height * k : k, : camera.width * k : k, 3] > 127
    is_whole = not (border(view.hull_alpha) > MASK_THRESHOLD).any()
    return _Small(camera, strict, binary_dilation(blocks, np.ones((3, 3))), is_whole)


def wrong_cameras(views: Sequence[View]) -> dict[int, float]:
    """{index: the share of its mask beside the hull of the right ones} of the views of which the
    camera, or all of the mask, is wrong. Views whose mask only lacks a part are not among them.
    """
    groups = -(-len(views) // TOGETHER)
    wrong: dict[int, float] = {}
    for first in range(groups if len(views) >= FEWEST else 0):
        found = _wrong_among([_small(view) for view in views[first::groups]])
        wrong |= {first + groups * i: share for i, share in found.items()}
    return wrong


def _wrong_among(small):
    rejects, places = _votes(small)
    n = len(small)
    rejected = rejects.all(3).mean(2)  # (voter, view): share of its rays
    contradict = rejected + rejected.T > CONTRADICTING
    core = np.ones(n, bool)
    most = math.ceil(MOST * n)
    while (degree := np.where(core, contradict[:, core].sum(1), 0)).max() > most / 2:
        core[degree.argmax()] = False
    while 2 * core.sum() > n:
        gains = _gains(rejects, core)
        if gains.max() <= max(LEAST_HARM, TIMES_HARM * np.median(gains[core])):
            break
        core[gains.argmax()] = False
    rejecting = rejects[core].sum(0, dtype=np.uint16)
    own = _beside(rejecting)
    rim = max(LEAST_OWN, TIMES_OWN * float(np.quantile(own[core], USUAL)))
    hull = places[core][rejecting[core] == 0]
    wrong = {}
    for i in np.flatnonzero(~core):
        harm = (_beside(rejecting + rejects[i]) - own)[core].mean()
        is_beside = own[i] > rim and harm > LEAST_HARM
        if is_beside or harm > MOST_HARM or (own[i] > MOST_OWN and _shown(small[i], hull)):
            wrong[int(i)] = float(own[i])
    return wrong


def _beside(rejecting):
    """(N,) share of each mask's rays on which some view rejects every place."""
    return (rejecting > 0).all(2).mean(1)


def _gains(rejects, core):
    """(N,) the share of their masks that the core's others regain if a view alone falls silent."""
    rejecting = rejects[core][:, core].sum(0, dtype=np.uint16)
    lost = (rejecting > 0).all(2)
    alone = rejecting[lost] == 1
    gains = np.zeros(len(core))
    for i in np.flatnonzero(core):
        gains[i] = (rejects[i, core][lost] & alone).any(1).sum()
    return gains / (lost.shape[1] * max(core.sum() - 1, 1))


def _shown(view, places):
    """Whether a view shows less than LEAST_SHOWN of some places on its mask."""
    column, row, is_shown = view.camera.pixels(places[:: max(1, len(places) // 1000)])
    return (is_shown & view.accepted[row, column]).mean() < LEAST_SHOWN if len(column) else False


def _votes(small):
    """((V, N, S, D) bool: whether view V rejects place D on ray S of view N, (N, S, D, 3) places).
    No view rejects places of its own.
    """
    rng, n = np.random.default_rng(0), len(small)
    rays = max(16, RAYS * FULL // max(FULL, n))
    axes, radii, directions = [], [], []
    for view in small:
        rows, columns = np.nonzero(view.strict)
        if not len(rows):
            rows, columns = (np.array([side // 2]) for side in view.strict.shape)
        camera, pixels = view.camera, np.stack([columns, rows], 1) + 0.5
        middle = (pixels.min(0) + pixels.max(0)) / 2
        axis, *all_rays = _directions(camera, np.vstack([middle, pixels]))
        axes.append(axis)
        radii.append(math.acos(np.clip((np.array(all_rays) @ axis).min(), -1, 1)))
        chosen = rng.choice(len(pixels), rays, replace=len(pixels) < rays)
        directions.append(np.array(all_rays)[np.sort(chosen)])
    eyes, radii = np.stack([view.camera.eye for view in small]), np.maximum(radii, 1e-3)
    centre, off, distance = consensus(eyes, np.array(axes), radii)
    reach = distance * np.sin(np.minimum(radii * (1 + off), 1.4))
    radius = WIDER * float(np.quantile(reach[off < 1] if (off < 1).any() else reach, AROUND))
    toward = np.array(directions)
    along = (toward * (centre - eyes)[:, None]).sum(2)
    inside = radius**2 - ((centre - eyes) ** 2).sum(1)[:, None] + along**2
    half = np.sqrt(np.maximum(inside, 0))
    near, far = np.maximum(along - half, 1e-9), np.maximum(along + half, 1e-9)
    misses = (inside <= 0) | (along + half <= 0)
    shares = (np.arange(PLACES) + 0.5) / PLACES
    depth = near[..., None] + (far - near)[..., None] * shares
    places = eyes[:, None, None] + depth[..., None] * toward[:, :, None]
    rejects = np.zeros((n, n, rays, PLACES), bool)
    for j, view in enumerate(small):
        column, row, is_shown = view.camera.pixels(places.reshape(-1, 3))
        beside = ~view.accepted[row, column]
        rejected = beside | ~is_shown if view.is_whole else beside & is_shown
        rejects[j] = rejected.reshape(rejects.shape[1:]) | misses[..., None]
        rejects[j, j] = False
    return rejects, places


def _directions(camera, pixels):
    """(P, 3) unit vectors of the world through (P, 2) places of a camera's image."""
    towards = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    towards = np.column_stack([towards, np.ones(len(towards))]) @ camera.pose[:, :3].T
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def consensus(
    eyes: np.ndarray, axes: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((3,) the place nearest to most views' axes, (N,) its angle to each in its radii, (N,) its
    distances). eyes, axes: (N, 3). radii: (N,) radians. Middles between the axes of pairs of views
    are tried; no wrong view moves the best.
    """
    i, j = np.triu_indices(len(eyes), 1)
    cosine, between = (axes[i] * axes[j]).sum(1), eyes[j] - eyes[i]
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    a, b = (between * axes[i]).sum(1), (between * axes[j]).sum(1)
    s, t = (a - cosine * b) / sine2, (cosine * a - b) / sine2
    middles = (eyes[i] + s[:, None] * axes[i] + eyes[j] + t[:, None] * axes[j]) / 2
    tried = middles[(sine2 > 0.01) & (s > 0) & (t > 0)]
    tried = tried[:: len(tried) // PAIRS + 1] if len(tried) else eyes.mean(0)[None]

    def seen(places):
        away = places[:, None] - eyes
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-12)
        return np.arccos(np.clip((away * axes).sum(2) / distance, -1, 1)), distance

    best = tried[np.minimum(seen(tried)[0] / radii, 1).sum(1).argmin()]
    for _ in range(10):
        angle, distance = (values[0] for values in seen(best[None]))
        weight = (angle < radii) / distance**2
        if (weight > 0).sum() < 3:
            break
        beside = weight[:, None, None] * (np.eye(3) - axes[:, :, None] * axes[:, None])
        best = np.linalg.lstsq(beside.sum(0), np.einsum("nij,nj->i", beside, eyes), rcond=1e-9)[0]
    angle, distance = (values[0] for values in seen(best[None]))
    return best, angle / radii, distance


def looking_away(views: Sequence[View]) -> list[int]:
    """The indices of views without masks whose cameras cannot be right: hardly any other image
    shows what they show, or they stand in the object or far from it.
    """
    if len(views) < FEWEST:
        return []
    cameras = [view.camera for view in views]
    compared, eyes = evenly(cameras, MANY), np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.pose[:, 2] for camera in cameras])
    radii = np.array([math.atan(min(c.width / c.fx, c.height / c.fy) / 2) for c in cameras])
    centre, _, distance = consensus(eyes, axes, radii)
    usual, away = float(np.median(distance)), []
    depths = usual * np.geomspace(0.25, 2, DEPTHS)
    across = (np.arange(GRID) + 0.5) / GRID
    for i, camera in enumerate(cameras):
        pixels = np.stack(np.meshgrid(across * camera.width, across * camera.height), -1)
        towards = _directions(camera, pixels.reshape(-1, 2))
        places = (eyes[i] + depths[:, None, None] * towards).reshape(-1, 3)
        others = [other for other in compared if other is not camera]
        together = np.sum([other.pixels(places)[2] for other in others], axis=0).max() / len(others)
        is_shown = bool(camera.pixels(centre[None])[2][0])
        share = distance[i] / usual
        if together < LEAST_TOGETHER or share > AWAY or share < (AT_IT if is_shown else INSIDE):
            away.append(i)
    return away
