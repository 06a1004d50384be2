"""Finds features of the images with OpenCV and matches them with NumPy, both many times faster on a
CPU than pycolmap, which checks and stores them. If an object turns before a fixed camera, matches
on the still background are removed, which would hide how the object moves.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import combinations, groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.sparse import coo_matrix

from pp_cl import Progress, track
from pp_cl.errors import UserError, shown
from pp_cl.files import mend
from pp_studio.capture.packages import needed

LENS = "SIMPLE_RADIAL"  # with more parameters, few photographs agree on a wrong focal length
LARGEST = 1600  # longer side, pixels; larger images are reduced for their features
FEATURES = 4096  # most features of an image: the largest are taken
CONTRAST = 0.02  # least contrast of a feature, of 1; three layers of an octave share it
UNIT = 512  # length of a descriptor of bytes, as in COLMAP
RATIO, FARTHEST = 0.8, 0.7  # largest angle of a match, in second best angles and in radians
PAIRS_AT_ONCE = 40  # pairs after which the bar moves and a stopped run can continue
EXHAUSTIVE = 25  # up to this many photographs, each is compared with all others
OVERLAP = 5  # images before and after an image with which it is compared
BEST = 10  # other images with which it is compared: those with the most similar large features
LARGE = 256  # the largest features, as they are found in most images, choose these
MOVED = 0.01  # of the longer side; features that move less may be still, as behind a turntable
LEAST_ALIKE = 4  # large features
# Of still features
SAMPLED = 30  # matches of a pair, for the alignment
LEAST_MATCHES = 15  # of a pair, at least half of them still
LEAST_PAIRS = 0.4  # share of pairs with these, of all with enough matches, if the object turns
STILL = 0.006  # of the longer side: once images are aligned, still features move less
# rounds of the alignment; distance, of the longer side, up to which a match counts, which shrinks
ROUNDS, WIDEST, NARROWER = 30, 0.05, 0.7
HELD = 0.001  # how strongly images without such matches are kept in place


@contextmanager
def quiet(work: Path) -> Iterator[Any]:
    """pycolmap without its log. Its errors, such as of a full disk, become UserErrors."""
    colmap = needed("pycolmap")
    colmap.logging.minloglevel = colmap.logging.FATAL
    try:
        yield colmap
    except RuntimeError as error:
        raise UserError(
            f"{work}: pycolmap stopped ({shown(str(error), 160)}); check the disk and its free"
            " space; the same command goes on"
        ) from error
    except OSError as error:
        raise UserError(f"{work}: cannot be written ({error.strerror}); {mend(error)}") from error


def find_features(
    database: Path, images: Path, taken: Sequence[dict[str, Any]], masks: Path | None = None
) -> dict[str, int]:
    """Add the features of each image, the largest first, to the database, unless it has them.

    taken: take_images()'s facts about the images; images of equal lens and size share a camera.
    masks: a folder with NAME.png for each image, black where no features are wanted. Returns {name:
    number of features}.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        for _, alike in groupby(sorted(taken, key=_camera), _camera):
            of_camera = list(alike)
            options = colmap.ImageReaderOptions(camera_model=LENS)
            if focal := of_camera[0]["focal"]:
                width, height = of_camera[0]["size"]
                options.camera_params = f"{focal},{width / 2},{height / 2},0"
            # This numbers the images by name. Otherwise COLMAP would number them in the order in
            # which their features are found, and matches and poses depend on the numbers.
            names = [image["name"] for image in of_camera]
            with Progress("reading what EXIF tells of lenses"):
                colmap.import_images(database, images, colmap.CameraMode.SINGLE, names, options)
        stored = db.read_all_images()
        missing = [image for image in stored if not db.exists_descriptors(image.image_id)]
        needed("cv2").setNumThreads(1)
        with ThreadPoolExecutor(cores()) as pool:
            made = pool.map(lambda image: _features(images / image.name, masks), missing)
            made = track(made, "features", "image", len(stored), done=len(stored) - len(missing))
            for image, (keypoints, descriptors) in zip(missing, made, strict=True):
                kind = colmap.FeatureExtractorType.SIFT
                with colmap.DatabaseTransaction(db):  # a stopped run leaves both or neither
                    db.write_keypoints(image.image_id, keypoints)
                    db.write_descriptors(
                        image.image_id, colmap.FeatureDescriptors(kind, descriptors)
                    )
        return {image.name: db.num_keypoints_for_image(image.image_id) for image in stored}


def _camera(image):
    return image["lens"], tuple(image["size"])


def _features(file, masks):
    """((N, 4) float32 x, y, scale, angle, (N, 128) uint8 descriptors), the largest first."""
    cv2 = needed("cv2")
    with Image.open(file) as image:
        size = np.array(image.size)
        reduced = tuple(np.maximum(1, np.rint(size * min(1, LARGEST / max(size)))).astype(int))
        image.draft("L", reduced)  # a JPEG is decoded at a half, a quarter or an eighth
        gray = np.array(image.convert("L").resize(reduced, Image.Resampling.BOX))
    mask = None
    if masks is not None:
        with Image.open(masks / f"{file.name}.png") as image:
            mask = np.array(image.convert("L").resize(reduced, Image.Resampling.NEAREST))
    sift = cv2.SIFT_create(contrastThreshold=CONTRAST, enable_precise_upscale=True)
    features, descriptors = sift.detectAndCompute(gray, mask)
    if not features:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    keypoints = np.array(
        [(*feature.pt, feature.size / 2, np.radians(feature.angle)) for feature in features]
    )
    # in photographs of a shiny head, twice as many of the largest features match as of the
    # strongest
    best = np.argsort(-keypoints[:, 2], kind="stable")[:FEATURES]
    keypoints, descriptors = keypoints[best], descriptors[best]
    larger = size / reduced
    keypoints[:, :2] = (keypoints[:, :2] + 0.5) * larger  # COLMAP's first pixel is centred at 0.5
    keypoints[:, 2] *= larger.mean()
    # square roots of the shares, so that a few strong gradients count less (Arandjelovic 2012)
    shares = np.sqrt(descriptors / descriptors.sum(1, keepdims=True))
    rounded = np.minimum(np.rint(UNIT * shares), 255).astype(np.uint8)
    return keypoints.astype(np.float32), rounded


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def match(database: Path) -> int:
    """Match the features of pairs of images that are not matched yet, and keep the pairs whose
    matches fit one motion of the camera. Returns the number of pairs kept in all.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        ids = [image.image_id for image in images]
        lenses = {lens.camera_id: max(lens.width, lens.height) for lens in db.read_all_cameras()}
        places = [db.read_keypoints(i.image_id)[:, :2] / lenses[i.camera_id] for i in images]
        descriptors = [np.array(db.read_descriptors(i).data) for i in ids]
        pairs = pairs_of(places, descriptors)
        pairs_left = [(i, j) for i, j in pairs if not db.exists_two_view_geometry(ids[i], ids[j])]
        with (
            ThreadPoolExecutor(cores()) as pool,
            tempfile.TemporaryDirectory(prefix="pp-cl-") as folder,
            Progress("matches", len(pairs), "pair", done=len(pairs) - len(pairs_left)) as progress,
        ):
            listed = Path(folder) / "pairs.txt"
            for first in range(0, len(pairs_left), PAIRS_AT_ONCE):
                batch = pairs_left[first : first + PAIRS_AT_ONCE]
                new = [(i, j) for i, j in batch if not db.exists_matches(ids[i], ids[j])]
                made = pool.map(lambda two: matches_of(*(descriptors[i] for i in two)), new)
                for (i, j), matches in zip(new, made, strict=True):
                    db.write_matches(ids[i], ids[j], matches)
                    progress.update()
                progress.update(len(batch) - len(new))
                lines = [f"{images[i].name} {images[j].name}\n" for i, j in batch]
                listed.write_text("".join(lines), "utf-8")
                colmap.verify_matches(database, listed, verification(colmap))
        return len(db.read_two_view_geometry_num_inliers()[0])


def matches_of(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(M, 2) uint32 pairs of rows in descriptors (N, 128) and (K, 128) uint8 that are each other's
    best match, and clearly better than the second best match of either.
    """
    none = np.zeros((0, 2), np.uint32)
    if min(len(one), len(other)) < 2:
        return none
    one, other = one.astype(np.float32), other.astype(np.float32)
    best, clearly = _best(one @ other.T)
    rows = np.flatnonzero(clearly)
    if not len(rows):
        return none
    back, sure = _best(other[best[rows]] @ one.T)
    mutual = sure & (back == rows)
    return np.stack([rows, best[rows]], axis=1)[mutual].astype(np.uint32)


def _best(products):
    """((...) indices of the largest of products (..., K), (...) bool: whether this match is close
    and clearly the best).

    Products of descriptors, whole numbers below 2^24, are exact.
    """
    best = products.argmax(-1)[..., None]
    largest = np.take_along_axis(products, best, -1)
    np.put_along_axis(products, best, -1, -1)
    angle, second = (
        np.arccos(np.minimum(product[..., 0] / UNIT**2, 1))
        for product in (largest, products.max(-1, keepdims=True))
    )
    return best[..., 0], (angle < FARTHEST) & (angle < RATIO * second)


def forget_matches(database: Path) -> None:
    """Remove all matches, so that match() starts again."""
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        db.clear_matches()
        db.clear_two_view_geometries()


def forget_focal_lengths(database: Path) -> bool:
    """If EXIF gave any focal lengths, replace them by COLMAP's guess, check the pairs again, and
    return True.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        factor = colmap.ImageReaderOptions().default_focal_length_factor
        cameras = [camera for camera in db.read_all_cameras() if camera.has_prior_focal_length]
        for camera in cameras:
            size = camera.width, camera.height
            db.update_camera(
                colmap.Camera.create_from_model_name(
                    camera.camera_id, LENS, factor * max(size), *size
                )
            )
        if cameras:
            _verify_anew(colmap, database, db)
    return bool(cameras)


def with_zooms(database: Path, images: Path, copy: Path, zooms: dict[str, int]) -> None:
    """Write a copy of the database in which photographs of another zoom have another lens, and
    check its pairs anew. zooms: {image: the number of its zoom}.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        stored = sorted(db.read_all_images(), key=lambda image: image.name)
        ids, lenses = {}, {(image.camera_id, zooms[image.name]) for image in stored}
        with colmap.Database.open(copy) as new:
            for number, zoom in sorted(lenses):
                of_lens = [i for i in stored if (i.camera_id, zooms[i.name]) == (number, zoom)]
                names = [image.name for image in of_lens]
                options = colmap.ImageReaderOptions(camera_model=LENS)
                lens = db.read_camera(number)
                options.camera_params = ",".join(map(str, lens.params))
                colmap.import_images(copy, images, colmap.CameraMode.SINGLE, names, options)
                for image in of_lens:
                    twin = new.read_image_with_name(image.name)
                    ids[image.image_id] = twin.image_id
                    new.write_keypoints(twin.image_id, db.read_keypoints(image.image_id))
                twin = new.read_camera(twin.camera_id)
                twin.has_prior_focal_length = False
                new.update_camera(twin)
            for pair, matches in zip(*db.read_all_matches(), strict=True):
                two = [ids[i] for i in colmap.pair_id_to_image_pair(pair)]
                new.write_matches(*two, matches)
            _verify_anew(colmap, copy, new)


def verification(colmap: Any) -> Any:
    """Options for checking pairs, with a seed, so that the same matches give the same pairs."""
    options = colmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    return options


def _verify_anew(colmap, database, db):
    db.clear_two_view_geometries()
    with Progress("checking pairs of images"):
        colmap.geometric_verification(database, two_view_geometry_options=verification(colmap))


def pairs_of(
    places: Sequence[np.ndarray], descriptors: Sequence[np.ndarray]
) -> list[tuple[int, int]]:
    """The pairs of images to match: all pairs if there are few images; otherwise images that follow
    each other (the first follow the last), and the images most similar to each image.

    places: (N, 2) positions of each image's features, whose longer side is 1; descriptors: (N, 128)
    uint8. In both, the largest features come first.
    """
    count = len(places)
    if count <= EXHAUSTIVE:
        return list(combinations(range(count), 2))
    alike = _alikeness(places, descriptors)
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    near = np.minimum(apart, count - apart) <= OVERLAP
    # in a row of similar images the best counts twice, so that not all are from one place
    rows = np.pad(alike, ((0, 0), (1, 1)))
    score = np.where(near, 0, alike * (1 + (alike >= np.maximum(rows[:, :-2], rows[:, 2:]))))
    best = np.argsort(-score, axis=1, kind="stable")[:, :BEST]
    chosen = np.zeros_like(near)
    np.put_along_axis(chosen, best, True, 1)
    chosen = near | ((chosen | chosen.T) & (score > 0))
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(chosen, 1))]


def _alikeness(places, descriptors):
    """(V, V) number of LARGE features that two images share at different places; few count as 0."""
    count = len(places)
    large = np.zeros((count, LARGE, 128), np.float32)  # zeros match no feature
    at = np.zeros((count, LARGE, 2), np.float32)
    for i, (place, vectors) in enumerate(zip(places, descriptors, strict=True)):
        large[i, : len(vectors)], at[i, : len(vectors)] = vectors[:LARGE], place[:LARGE]
    alike = np.zeros((count, count), int)
    for i in track(range(count - 1), "choosing pairs", "image"):
        products = (large[i + 1 :].reshape(-1, 128) @ large[i].T).reshape(-1, LARGE, LARGE)
        mine = products.argmax(1)
        theirs, clearly = _best(products)
        features = np.arange(LARGE)
        mutual = clearly & (np.take_along_axis(mine, theirs, 1) == features)
        moved = np.abs(at[i][theirs] - at[i + 1 :]).max(2) > MOVED
        alike[i, i + 1 :] = (mutual & moved).sum(1)
    alike[alike < LEAST_ALIKE] = 0
    return alike + alike.T


def remove_still(database: Path, begun: Path, is_turntable: bool) -> bool:
    """If most pairs of images share a still background, remove its matches from the database, check
    the pairs again, and return True.

    Images are aligned by shifts, rotations and scales, so that the camera may move a little. begun:
    a file that is created before anything is removed. is_turntable: the object is known to turn.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        images = db.read_all_images()
        sizes = {i.camera_id: np.array([i.width, i.height]) for i in db.read_all_cameras()}
        index = {image.image_id: k for k, image in enumerate(images)}
        places = []  # complex numbers: 0 is the image's middle, 1 its longer side
        for image in images:
            pixels, size = db.read_keypoints(image.image_id)[:, :2], sizes[image.camera_id]
            places.append((pixels.astype(float) - size / 2) @ [1, 1j] / max(size))
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
        counted = [is_still for is_still in still if len(is_still) >= LEAST_MATCHES]
        shared = sum(
            is_still.sum() >= max(LEAST_MATCHES, len(is_still) / 2) for is_still in counted
        )
        if not is_turntable and (not counted or shared < LEAST_PAIRS * len(counted)):
            return False
        votes = [np.zeros((len(place), 2), int) for place in places]
        for (_, i, j, m), is_still in zip(pairs, still, strict=True):
            np.add.at(votes[i], (m[:, 0], is_still.astype(int)), 1)
            np.add.at(votes[j], (m[:, 1], is_still.astype(int)), 1)
        stays = [(v[:, 1] > 1) & (v[:, 1] > v[:, 0]) for v in votes]
        begun.touch()
        with colmap.DatabaseTransaction(db):
            for (ids, i, j, m), is_still in zip(pairs, still, strict=True):
                matches_left = m[~(is_still | stays[i][m[:, 0]] | stays[j][m[:, 1]])]
                db.delete_matches(*ids)
                db.write_matches(*ids, matches_left)
        _verify_anew(colmap, database, db)
    return True


def _aligned(places: list[np.ndarray], pairs: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """((V,) complex scales with rotations, (V,) shifts) that align the images, robustly."""
    rng, count = np.random.default_rng(0), len(places)
    drawn = []
    for _, i, j, matches in pairs:
        sample = matches[rng.permutation(len(matches))[:SAMPLED]]
        ends = np.full(len(sample), i), np.full(len(sample), j)
        drawn.append((*ends, places[i][sample[:, 0]], places[j][sample[:, 1]]))
    first, second, at_first, at_second = map(np.concatenate, zip(*drawn, strict=True))
    rows = np.tile(np.arange(len(at_first)), 4)
    columns = np.concatenate([first, first + count, second, second + count])
    scales, shifts = np.ones(count, complex), np.zeros(count, complex)
    hold = HELD * len(at_first) / count * np.eye(2 * count)
    for number in range(ROUNDS):
        off = abs(
            scales[first] * at_first + shifts[first] - scales[second] * at_second - shifts[second]
        )
        weight = 1 / (1 + (off / max(STILL, WIDEST * NARROWER**number)) ** 2)
        values = np.concatenate([at_first * weight, weight, -at_second * weight, -weight])
        system = coo_matrix((values, (rows, columns)), shape=(len(at_first), 2 * count)).tocsr()
        normal = (system.conj().T @ system).toarray() + hold
        solution = np.linalg.solve(normal, hold @ np.repeat([1.0, 0.0], count))
        scales, shifts = solution[:count], solution[count:]
        shifts, scales = (shifts - shifts.mean()) / scales.mean(), scales / scales.mean()
    return scales, shifts
