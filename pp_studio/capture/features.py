"""Features of the images and their matches, by pycolmap on the CPU, kept in its database."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations, groupby
from pathlib import Path
from typing import Any

from pp_cl import Progress
from pp_cl.errors import UserError, shown
from pp_cl.files import mend
from pp_studio.capture.packages import needed

LENS = "SIMPLE_RADIAL"  # with more, few photographs agree on a wrong focal length
LARGEST = 1600  # pixels, longer side; larger images are reduced for their features
FEATURES = 8192  # of an image, at most
AT_ONCE = 32  # images, between two states of the bar and where a stopped run goes on
PAIRS_AT_ONCE = 200
EXHAUSTIVE = 150  # photographs of which each is compared with each
OVERLAP = 10  # frames before and after that one is compared with
LOOPS = 50  # frames that are compared with each other wherever they are in the video


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
    """Add the features of each image to the database, where they are not there yet.

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
            colmap.import_images(database, images, colmap.CameraMode.SINGLE, names, options)
        options = colmap.ImageReaderOptions(camera_model=LENS)
        if masks is not None:
            options.mask_path = masks
        extraction = colmap.FeatureExtractionOptions(
            max_image_size=LARGEST, use_gpu=False, num_threads=cores()
        )
        extraction.sift.max_num_features = FEATURES
        found = db.read_all_images()
        for some in _in_parts([image.name for image in found], AT_ONCE, "features", "image"):
            colmap.extract_features(
                database, images, some, colmap.CameraMode.AUTO, options, extraction
            )
        return {image.name: db.num_keypoints_for_image(image.image_id) for image in found}


def _camera(one):
    return one["lens"], tuple(one["size"])


def _in_parts(items, count, what, unit):
    """Lists of so many of the items, under a progress bar. COLMAP leaves out what is done."""
    with Progress(what, len(items), unit) as bar:
        for first in range(0, len(items), count):
            yield (some := items[first : first + count])
            bar.update(len(some))


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def match(database: Path, is_video: bool) -> int:
    """Match the features of pairs of images, where that is not done yet, and keep the pairs whose
    matches fit one motion of the camera. Returns their number.
    """
    with quiet(database) as colmap, colmap.Database.open(database) as db:
        pairs = pairs_of(sorted(image.name for image in db.read_all_images()), is_video)
        matching = colmap.FeatureMatchingOptions(use_gpu=False, num_threads=cores())
        with tempfile.TemporaryDirectory(prefix="pp-cl-") as folder:
            listed = Path(folder) / "pairs.txt"
            options = colmap.ImportedPairingOptions(match_list_path=listed)
            for some in _in_parts(pairs, PAIRS_AT_ONCE, "matches", "pair"):
                listed.write_text("".join(f"{a} {b}\n" for a, b in some), "utf-8")
                colmap.match_image_pairs(database, matching, options, verification(colmap))
        return db.num_verified_image_pairs()


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


def pairs_of(names: Sequence[str], is_video: bool) -> list[tuple[str, str]]:
    """The pairs to match: all of them, or for videos and many photographs those that follow each
    other, and for loops each of some with each.
    """
    count = len(names)
    if count <= EXHAUSTIVE and not is_video:
        return list(combinations(names, 2))
    near = {(i, j) for i, j in combinations(range(count), 2) if j - i <= OVERLAP}
    some = set(combinations(range(0, count, -(-count // LOOPS)), 2))
    return [(names[i], names[j]) for i, j in sorted(near | some)]
