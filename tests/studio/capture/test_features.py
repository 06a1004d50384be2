import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")

from pp_studio.capture import features

VIEWS, ROUND, SHOWN = 60, 30, 400


def descriptors(rng, count):
    """(N, 128) uint8, normalised as COLMAP's."""
    histograms = rng.exponential(1, (count, 128)) ** 2
    shares = np.sqrt(histograms / histograms.sum(1, keepdims=True))
    return np.minimum(np.rint(features.UNIT * shares), 255).astype(np.uint8)


def test_matches_are_each_others_best_and_clearly_so(rng):
    """The matches are those of an exhaustive search; descriptors that occur twice match nothing."""
    first, noise = descriptors(rng, 300), rng.integers(-3, 4, (300, 128))
    second = np.clip(rng.permutation(first)[:200] + noise[:200], 0, 255).astype(np.uint8)
    second[10] = second[20]
    angles = np.arccos(np.minimum(first.astype(float) @ second.T.astype(float) / 512**2, 1))
    expected = []
    for i in range(len(first)):
        j = angles[i].argmin()
        rivals = np.delete(angles[i], j).min(), np.delete(angles[:, j], i).min()
        if angles[i, j] < min(0.7, 0.8 * min(rivals)):
            expected.append((i, j))
    assert len(expected) > 150
    np.testing.assert_array_equal(features.matches_of(first, second), expected)
    assert features.matches_of(first, second[:1]).shape == (0, 2)


def round_of(rng, is_still):
    """(places, descriptors) of two rounds around an object, where each view shares half of its
    descriptors with the next; is_still: of a wall that stands still and is the same in all views.
    """
    places, view_descriptors = [], []
    known = descriptors(rng, ROUND * SHOWN // 2 + SHOWN // 2)
    known[-SHOWN // 2 :] = known[: SHOWN // 2]
    for view in range(VIEWS):
        first = 0 if is_still else view % ROUND * SHOWN // 2
        view_descriptors.append(known[first : first + SHOWN])
        at = np.random.default_rng(0 if is_still else view)
        places.append(at.uniform(0, 1, (SHOWN, 2)).astype(np.float32))
    return places, view_descriptors


def test_pairs_are_neighbours_and_what_shows_the_same_in_another_round(rng):
    pairs = set(features.pairs_of(*round_of(rng, False)))
    assert len(pairs) < VIEWS * (features.OVERLAP + features.BEST) < VIEWS * (VIEWS - 1) / 2
    apart = {(i, (i + k) % VIEWS) for i in range(VIEWS) for k in range(1, features.OVERLAP + 1)}
    assert {(min(two), max(two)) for two in apart} <= pairs
    assert {(i, i + ROUND) for i in range(ROUND)} <= pairs


def test_a_wall_that_stands_still_chooses_no_pairs(rng):
    """The wall behind a turntable looks equally alike in all views."""
    pairs = features.pairs_of(*round_of(rng, True))
    assert len(pairs) == VIEWS * features.OVERLAP


@pytest.mark.parametrize("factor", [1, 3])
def test_features_of_reduced_photographs_lie_where_they_were(tmp_path, factor):
    """The JPEG is decoded at half its size, and reduced further."""
    shown = np.full((1200, 1200), 90.0)
    rows, columns = np.mgrid[:1200, :1200] + 0.5
    middles = [(300.25, 410.5), (700.0, 820.75), (900.5, 250.0)]
    for x, y in middles:
        shown += 140 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 12**2))
    large = np.kron(np.clip(shown, 0, 255).astype(np.uint8), np.ones((factor, factor), np.uint8))
    Image.fromarray(large).save(tmp_path / "a.jpg", quality=98)
    keypoints, vectors = features._features(tmp_path / "a.jpg", None)
    assert (np.diff(keypoints[:, 2]) <= 0).all() and len(vectors) == len(keypoints)
    for middle in middles:
        off = np.linalg.norm(keypoints[:, :2] / factor - middle, axis=1)
        near = keypoints[off.argmin(), 2] / factor
        assert off.min() < 0.4 and near == pytest.approx(12, rel=0.25)
