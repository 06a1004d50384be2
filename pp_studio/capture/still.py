"""Finds matches that stand still in the images: what is behind an object that turns before a camera
that stays, which would hide how the object moves.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix

from pp_cl import Progress
from pp_studio.capture.features import quiet, verification

SAMPLED = 30  # matches of a pair
LEAST_MATCHES = 15  # of a pair, of which at least a half stand still
LEAST_PAIRS = 0.4  # of all pairs with so many matches, of photographs of an object that turns
STILL = 0.006  # of the longer side: what stands still moves no further, once images are aligned
ROUNDS, WIDEST, NARROWER = 30, 0.05, 0.7  # of the alignment: matches that it believes
HELD = 0.001  # how strongly images without such matches are kept in place


def remove_still(database: Path, begun: Path, is_turntable: bool) -> bool:
    """Where most pairs of images share what stands still, remove its matches from the database,
    check the pairs anew, and return True.

    Images are aligned by shifts, turns and scales, so that the camera may be moved a little.
    begun: a file that says so before anything is removed; where it exists, this was stopped, and
    goes on. is_turntable: the object is known to turn.
    """
    is_turntable = is_turntable or begun.exists()
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        images = db.read_all_images()
        sizes = {i.camera_id: i for i in db.read_all_cameras()}
        index = {image.image_id: k for k, image in enumerate(images)}
        places = [
            _places(db.read_keypoints(image.image_id)[:, :2].astype(float), sizes[image.camera_id])
            for image in images
        ]
        pairs = []
        for number, matches in zip(*db.read_all_matches(), strict=True):
            ids = colmap.pair_id_to_image_pair(number)
            if len(matches):
                pairs.append((ids, index[ids[0]], index[ids[1]], np.array(matches)))
        if not pairs:
            return False
        scales, shifts = _aligned(places, pairs)
        moved = [s * place + t for s, t, place in zip(scales, shifts, places, strict=True)]
        still = [abs(moved[i][m[:, 0]] - moved[j][m[:, 1]]) < STILL for _, i, j, m in pairs]
        counted = [one for one in still if len(one) >= LEAST_MATCHES]
        shared = sum(one.sum() >= max(LEAST_MATCHES, len(one) / 2) for one in counted)
        if not is_turntable and shared < LEAST_PAIRS * len(counted):
            return False
        votes = [np.zeros((len(place), 2), int) for place in places]
        for (_, i, j, m), one in zip(pairs, still, strict=True):
            np.add.at(votes[i], (m[:, 0], one.astype(int)), 1)
            np.add.at(votes[j], (m[:, 1], one.astype(int)), 1)
        stays = [(v[:, 1] > 1) & (v[:, 1] > v[:, 0]) for v in votes]
        begun.touch()
        with colmap.DatabaseTransaction(db):
            for (ids, i, j, m), one in zip(pairs, still, strict=True):
                left = m[~(one | stays[i][m[:, 0]] | stays[j][m[:, 1]])]
                db.delete_matches(*ids)
                db.write_matches(*ids, left)
            db.clear_two_view_geometries()
        with Progress("checking pairs without what stands still"):
            colmap.geometric_verification(database, two_view_geometry_options=verification(colmap))
    return True


def _places(pixels, camera):
    """Complex numbers of pixels, 0 in the image's middle, the longer side being 1."""
    middle = np.array([camera.width, camera.height]) / 2
    return (pixels - middle) @ [1, 1j] / max(camera.width, camera.height)


def _aligned(places: list[np.ndarray], pairs: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """((V,) complex scales with turns, (V,) complex shifts) that lay the images over each other
    where most pairs agree, by least squares with weights that fall off.
    """
    rng, count = np.random.default_rng(0), len(places)
    drawn = []
    for _, i, j, matches in pairs:
        some = matches[rng.permutation(len(matches))[:SAMPLED]]
        ends = np.full(len(some), i), np.full(len(some), j)
        drawn.append((*ends, places[i][some[:, 0]], places[j][some[:, 1]]))
    first, second, one, other = map(np.concatenate, zip(*drawn, strict=True))
    rows = np.tile(np.arange(len(one)), 4)
    columns = np.concatenate([first, first + count, second, second + count])
    scales, shifts = np.ones(count, complex), np.zeros(count, complex)
    hold = HELD * len(one) / count * np.eye(2 * count)
    for number in range(ROUNDS):
        off = abs(scales[first] * one + shifts[first] - scales[second] * other - shifts[second])
        weight = 1 / (1 + (off / max(STILL, WIDEST * NARROWER**number)) ** 2)
        values = np.concatenate([one * weight, weight, -other * weight, -weight])
        system = coo_matrix((values, (rows, columns)), shape=(len(one), 2 * count)).tocsr()
        normal = (system.conj().T @ system).toarray() + hold
        found = np.linalg.solve(normal, hold @ np.repeat([1.0, 0.0], count))
        scales, shifts = found[:count], found[count:]
        shifts, scales = (shifts - shifts.mean()) / scales.mean(), scales / scales.mean()
    return scales, shifts
