"""Features of the images by OpenCV and their matches by NumPy, both many times faster than those of
pycolmap on a CPU; it checks them, and keeps them in its database.
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

from pp_cl import Progress, track
from pp_cl.errors import UserError, shown
from pp_cl.files import mend
from pp_studio.capture.packages import needed

LENS = "SIMPLE_RADIAL"  # with more, few photographs agree on a wrong focal length
LARGEST = 1600  # pixels, longer side; larger images are reduced for their features
FEATURES = 4096  # of an image, at most: the largest
CONTRAST = 0.02  # of a feature, of 1, at least; three layers of an octave share it
UNIT = 512  # length of a descriptor of bytes, as COLMAP has them
RATIO, FARTHEST = 0.8, 0.7  # of the second best match's angle, and radians
PAIRS_AT_ONCE = 40  # between two states of the bar and where a stopped run goes on
EXHAUSTIVE = 25  # photographs of which each is compared with each
OVERLAP = 5  # images before and after that one is compared with
BEST = 10  # others that one is compared with, whose large features are most alike
LARGE = 256  # features that tell these: the largest, as they are found in most images
MOVED = 0.01  # of the longer side: what stands still, as behind a turntable, tells nothing
LEAST_ALIKE = 4  # large features


@contextmanager
def quiet(work: Path) -> Iterator[Any]:
    """pycolmap without its log. What it says of a disk that cannot be written is a UserError."""
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
    """Add the features of each image to the database, where they are not there yet, the largest
    first.

    taken: what take_images() says of the images; those of equal lens and size have one camera.
    masks: NAME.png of each image, black where no features are wanted. Returns {name: features}.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        for _, alike in groupby(sorted(taken, key=_camera), _camera):
            of_camera = list(alike)
            options = colmap.ImageReaderOptions(camera_model=LENS)
            if focal := of_camera[0]["focal"]:
                width, height = of_camera[0]["size"]
                options.camera_params = f"{focal},{width / 2},{height / 2},0"
            # numbers them by name; later COLMAP would, as their features happen to be found, and
            # matches and poses depend on the numbers
            names = [one["name"] for one in of_camera]
            with Progress("reading what EXIF tells of lenses"):
                colmap.import_images(database, images, colmap.CameraMode.SINGLE, names, options)
        found = db.read_all_images()
        left = [image for image in found if not db.exists_descriptors(image.image_id)]
        needed("cv2").setNumThreads(1)
        with ThreadPoolExecutor(cores()) as pool:
            made = pool.map(lambda image: _features(images / image.name, masks), left)
            made = track(made, "features", "image", len(found), done=len(found) - len(left))
            for image, (keypoints, descriptors) in zip(left, made, strict=True):
                kind = colmap.FeatureExtractorType.SIFT
                with colmap.DatabaseTransaction(db):  # a stopped run leaves both or none
                    db.write_keypoints(image.image_id, keypoints)
                    db.write_descriptors(
                        image.image_id, colmap.FeatureDescriptors(kind, descriptors)
                    )
        return {image.name: db.num_keypoints_for_image(image.image_id) for image in found}


def _camera(one):
    return one["lens"], tuple(one["size"])


def _features(file, masks):
    """((N, 4) float32 x, y, scale and angle of an image's features, COLMAP's first pixel being
    centred at 0.5, (N, 128) uint8 descriptors), the largest first.
    """
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
    found, descriptors = sift.detectAndCompute(gray, mask)
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    keypoints = np.array([(*one.pt, one.size / 2, np.radians(one.angle)) for one in found])
    # of photographs of a shining head twice as many of the largest match as of the strongest
    best = np.argsort(-keypoints[:, 2], kind="stable")[:FEATURES]
    keypoints, descriptors = keypoints[best], descriptors[best]
    larger = size / reduced
    keypoints[:, :2] = (keypoints[:, :2] + 0.5) * larger
    keypoints[:, 2] *= larger.mean()
    # the root of what they share, by which a few strong gradients count less (Arandjelovic 2012)
    shares = np.sqrt(descriptors / descriptors.sum(1, keepdims=True))
    rounded = np.minimum(np.rint(UNIT * shares), 255).astype(np.uint8)
    return keypoints.astype(np.float32), rounded


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def match(database: Path) -> int:
    """Match the features of pairs of images, where that is not done yet, and keep the pairs whose
    matches fit one motion of the camera. Returns their number.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        ids = [image.image_id for image in images]
        sizes = {camera.camera_id: camera for camera in db.read_all_cameras()}
        longer = [max(sizes[one.camera_id].width, sizes[one.camera_id].height) for one in images]
        places = [db.read_keypoints(i)[:, :2] / size for i, size in zip(ids, longer, strict=True)]
        descriptors = [np.array(db.read_descriptors(i).data) for i in ids]
        pairs = pairs_of(places, descriptors)
        left = [(i, j) for i, j in pairs if not db.exists_two_view_geometry(ids[i], ids[j])]
        with (
            ThreadPoolExecutor(cores()) as pool,
            tempfile.TemporaryDirectory(prefix="pp-cl-") as folder,
            Progress("matches", len(pairs), "pair", done=len(pairs) - len(left)) as progress,
        ):
            listed = Path(folder) / "pairs.txt"
            for first in range(0, len(left), PAIRS_AT_ONCE):
                some = left[first : first + PAIRS_AT_ONCE]
                new = [(i, j) for i, j in some if not db.exists_matches(ids[i], ids[j])]
                made = pool.map(lambda two: matches_of(*(descriptors[i] for i in two)), new)
                for (i, j), found in zip(new, made, strict=True):
                    db.write_matches(ids[i], ids[j], found)
                    progress.update()
                progress.update(len(some) - len(new))
                lines = [f"{images[i].name} {images[j].name}\n" for i, j in some]
                listed.write_text("".join(lines), "utf-8")
                colmap.verify_matches(database, listed, verification(colmap))
        return len(db.read_two_view_geometry_num_inliers()[0])


def matches_of(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(M, 2) uint32 rows of descriptors (N, 128) and (K, 128) uint8 that are each other's best, and
    clearly better than the second best of either.
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
    """((...) places of the largest of the last axis of descriptors' products (..., K), (...) bool
    whether it is close, and clearly the best). The products, whole numbers below 2^24, are exact.
    """
    best = products.argmax(-1)[..., None]
    largest = np.take_along_axis(products, best, -1)
    np.put_along_axis(products, best, -1, -1)
    angle, second = (
        np.arccos(np.minimum(one[..., 0] / UNIT**2, 1))
        for one in (largest, products.max(-1, keepdims=True))
    )
    return best[..., 0], (angle < FARTHEST) & (angle < RATIO * second)


def forget_matches(database: Path) -> None:
    """Remove all matches, so that match() begins anew."""
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        db.clear_matches()
        db.clear_two_view_geometries()


def forget_focal_lengths(database: Path) -> bool:
    """Where EXIF told any, begin with COLMAP's guess, check the pairs anew, and return True."""
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        factor = colmap.ImageReaderOptions().default_focal_length_factor
        told = [camera for camera in db.read_all_cameras() if camera.has_prior_focal_length]
        for one in told:
            size = one.width, one.height
            db.update_camera(
                colmap.Camera.create_from_model_name(one.camera_id, LENS, factor * max(size), *size)
            )
        if told:
            db.clear_two_view_geometries()
            colmap.geometric_verification(database, two_view_geometry_options=verification(colmap))
    return bool(told)


def verification(colmap: Any) -> Any:
    """How pairs are checked; with a seed, so that the same matches give the same pairs."""
    options = colmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    return options


def pairs_of(
    places: Sequence[np.ndarray], descriptors: Sequence[np.ndarray]
) -> list[tuple[int, int]]:
    """The pairs of images to match: all of few images; else those that follow each other, the last
    and the first ones, too, and with each image those that are most alike.

    places: (N, 2) of each image's features, its longer side being 1; descriptors: (N, 128) uint8.
    Of both the largest come first.
    """
    count = len(places)
    if count <= EXHAUSTIVE:
        return list(combinations(range(count), 2))
    alike = _alikeness(places, descriptors)
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    near = np.minimum(apart, count - apart) <= OVERLAP
    # of a row of images that are alike the best counts twice, or they would be of one place
    rows = np.pad(alike, ((0, 0), (1, 1)))
    score = np.where(near, 0, alike * (1 + (alike >= np.maximum(rows[:, :-2], rows[:, 2:]))))
    best = np.argsort(-score, axis=1, kind="stable")[:, :BEST]
    chosen = np.zeros_like(near)
    np.put_along_axis(chosen, best, True, 1)
    chosen = near | ((chosen | chosen.T) & (score > 0))
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(chosen, 1))]


def _alikeness(places, descriptors):
    """(V, V) how many of their LARGE features images have in common that are not at the same place;
    0 where these are few.
    """
    count = len(places)
    large = np.zeros((count, LARGE, 128), np.float32)  # what is missing is like nothing
    at = np.zeros((count, LARGE, 2), np.float32)
    for i, (place, some) in enumerate(zip(places, descriptors, strict=True)):
        large[i, : len(some)], at[i, : len(some)] = some[:LARGE], place[:LARGE]
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
