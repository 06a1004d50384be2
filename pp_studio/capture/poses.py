"""Finds where each image was taken, with pycolmap's incremental mapping, and why some images have
no place.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl import Camera, Progress
from pp_cl.errors import UserError
from pp_cl.files import atomic_folder
from pp_cl.scene import ImageFile, LensDistortion
from pp_studio.capture.features import cores, forget_focal_lengths, quiet
from pp_studio.capture.packages import needed

LEAST_SHARE = 0.5  # share of the images that must have a place
MANY = 0.75  # if fewer images of a turned object have a sound place, usual placing is tried, too
FEW_FEATURES, FEW_MATCHES = 200, 30
GROWTH = 1.4  # COLMAP's 1.1 takes twice the time
CLOSER = 8.0  # degrees between the two images with which the mapping of a turned object begins
# Pairs of images of a turned object with a smaller share of the usual number of matches are far
# apart, or look alike because a pattern repeats: nothing behind it outvotes them. Weaker pairs only
# add the images that strong ones do not place.
STRONG, WEAK = 0.4, 0.15
# Two images that match each other about as well as any contradict a model in which fewer of these
# matches are the same point: of neighbours, half are in sound models, a sixth beside a wrong place.
SAME_BEST, SAME_POINT = 0.75, 0.25
# One round of cameras hardly tells lens distortion from distance. Distortion must lower the error
# by this share: of the demo, whose lens is straight, it does by 0.005, of a museum's head by 0.017.
DISTORTS = 0.01
BELIEVED = 2.0  # median errors of the points: observations with larger errors count less
CONVERGED = 1e-5  # relative change of the sum of errors
MOST_ERROR = 20.0  # pixels of mean reprojection error
BLURRED = 0.4  # of the median sharpness


def place(
    database: Path, images: Path, model: Path, taken: Sequence[dict], turns: bool
) -> dict[str, Any]:
    """Write the largest model that the matches give to the new folder `model`.

    taken: take_images()'s facts about the images. turns: the object turns before a fixed camera,
    and all matches are on the object; if few images fit in this way, they are placed as usual.
    Returns the numbers of images and points, the reprojection error in pixels, {image: reason} for
    images without a place, and the images of a turned object that have a place by weak pairs alone.
    Raises UserError if these are more than half, and if the cameras
    around a turned object contradict the matches.
    """
    least = max(3, LEAST_SHARE * len(taken))

    def is_sound(candidate, least):
        return candidate.num_reg_images() >= least and not (
            turns and contradictions(database, candidate)
        )

    with atomic_folder(model) as unfinished:
        map_all = _mapped_turned if turns else _mapped
        candidates = map_all(database, images, unfinished, len(taken))
        if turns and not any(is_sound(candidate, MANY * len(taken)) for candidate in candidates):
            (usual := unfinished / "usual").mkdir()
            candidates += _mapped(database, images, usual, len(taken))
        # the focal lengths of EXIF may be for another size
        if all(candidate.num_reg_images() < least for candidate in candidates):
            (again := unfinished / "again").mkdir()
            copy = Path(shutil.copy(database, again))  # a stopped run must find its own unchanged
            if forget_focal_lengths(copy):
                candidates += map_all(copy, images, again, len(taken))
        for folder in list(unfinished.iterdir()):
            shutil.rmtree(folder)
        candidates.sort(
            key=lambda candidate: (
                is_sound(candidate, least),
                candidate.num_reg_images(),
                candidate.num_points3D(),
            )
        )
        while candidates:
            best = candidates[-1]
            with Progress("refining all poses"):
                best = _refined_turned(best) if turns else refine(best)
            if (error := best.compute_mean_reprojection_error()) < MOST_ERROR:
                best.write(unfinished)
                break
            candidates.pop()  # its optimisation failed
        placed = (
            {image.name for image in best.images.values() if image.has_pose} if candidates else ()
        )
        reasons = _reasons(database, taken, placed)
        if len(placed) < least:
            examples = "; ".join(f"{name} {why}" for name, why in list(reasons.items())[:3])
            raise UserError(
                f"{images}: only {len(placed)} of {len(taken)} images could be placed ({examples});"
                " take more of them with more overlap (10 degrees apart or less), sharp and of an"
                " object that has some texture"
            )
        if turns and (wrong := contradictions(database, best)):
            raise UserError(
                f"{images}: {wrong[0][0]} and {wrong[0][1]} show the same side of the object, but"
                " not from the places that were found, so that cameras are wrong; turn the object"
                " by 3 to 5 degrees between photographs, and give it, or what it stands on, a"
                " pattern that does not repeat"
            )
        return {
            "placed": len(placed),
            "points": best.num_points3D(),
            "error": round(error, 3),
            "unplaced": reasons,
            "weak": _weak(database, placed) if turns else [],
        }


def _mapped_turned(database, images, folder, count):
    """pycolmap's models of a turned object: those of its strong pairs, and, unless these place all
    images, one to which weaker pairs add the others.
    """
    (strong := folder / "strong").mkdir()
    models = _mapped(database, images, strong, count, STRONG)
    best = max(models, key=lambda model: model.num_reg_images(), default=None)
    if best is not None and contradictions(database, best):
        best = None  # weaker pairs begin anew
    elif best is not None and best.num_reg_images() == count:
        return models
    (weak := folder / "weak").mkdir()
    return models + _mapped(database, images, weak, count, WEAK, best)


def _mapped(database, images, folder, count, share=None, begun=None):
    """pycolmap's models, each of images that fit together. share: pairs of a turned object have at
    least this share of the usual number of matches. begun: a model to which images are added.
    """
    with quiet(database) as colmap:
        options = colmap.IncrementalPipelineOptions(
            min_model_size=3, num_threads=cores(), random_seed=0
        )
        # all cameras are refined at the end, and before whenever their number has grown so much
        options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWTH
        # Without a background, a pair as far apart as the one with which COLMAP begins has fewer
        # matches than a pattern with itself; closer pairs do not tell focal length from distortion.
        if share is not None:
            usual = np.median(list(_most_matches(database).values()))
            options.min_num_matches = max(options.min_num_matches, int(share * usual))
            options.mapper.init_min_tri_angle = CLOSER
            options.ba_refine_extra_params = False  # _refined_turned() finds them
        begin, done = {}, 0
        if begun is not None:
            (at := folder / "begun").mkdir()
            begun.write(at)
            begin, done = {"input_path": at}, begun.num_reg_images()
        with Progress("poses", count, "image", done=done) as bar:
            models = colmap.incremental_mapping(
                database, images, folder, options, next_image_callback=bar.update, **begin
            )
            return list(models.values())


def contradictions(database: Path, model: Any) -> list[tuple[str, str]]:
    """The pairs of images, the worst first, that have about as many matches with each other as
    either has with any, but for the most part not as the same points of pycolmap's model.
    """
    names, shown = {}, {}
    for image in _placed(model):
        names[image.image_id] = image.name
        of_point = [point.point3D_id if point.has_point3D() else -1 for point in image.points2D]
        shown[image.image_id] = np.array(of_point, np.int64)
    colmap = needed("pycolmap")
    with colmap.Database.open(database) as db:
        numbers, checked = db.read_two_view_geometries()
    pairs, best = [], dict.fromkeys(names, FEW_MATCHES)
    for number, geometry in zip(numbers, checked, strict=True):
        first, second = colmap.pair_id_to_image_pair(number)
        matches = np.array(geometry.inlier_matches)
        if first in names and second in names and len(matches):
            points = shown[first][matches[:, 0]], shown[second][matches[:, 1]]
            same = ((points[0] == points[1]) & (points[0] >= 0)).mean()
            pairs.append((same, len(matches), first, second))
            best |= {i: max(best[i], len(matches)) for i in (first, second)}
    return [
        (names[first], names[second])
        for same, count, first, second in sorted(pairs)
        if same < SAME_POINT and count >= SAME_BEST * max(best[first], best[second])
    ]


def refine(model: Any, distorts: bool = True) -> Any:
    """Adjust all cameras and points of a model once more, with a loss that keeps the few wrong
    matches, mostly of repeating patterns, from pulling at the cameras. distorts: the lens, too.
    Returns the model.
    """
    colmap = needed("pycolmap")
    model.update_point_3d_errors()
    error = np.median([point.error for point in model.points3D.values()])
    options = colmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_extra_params = distorts
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = BELIEVED * error
    options.ceres.solver_options.function_tolerance = CONVERGED
    options.ceres.solver_options.num_threads = cores()
    colmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    return model


def _refined_turned(model):
    """A model of a turned object, refined, with a distorted lens only if that is sure."""
    straight = needed("pycolmap").Reconstruction(model)
    for lens in straight.cameras.values():
        lens.params = [*lens.params[:3], 0]
    errors = [
        refine(candidate, candidate is model).compute_mean_reprojection_error()
        for candidate in (straight, model)
    ]
    return model if errors[1] < (1 - DISTORTS) * errors[0] else straight


def _reasons(database, taken, placed):
    """{image without a place: the reason}."""
    best = _most_matches(database)
    with needed("pycolmap").Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(i) for name, i in ids.items()}
    usual = np.median([image["sharpness"] for image in taken])
    reasons = {}
    for image in (image for image in taken if image["name"] not in placed):
        name, sharpness = image["name"], image["sharpness"] / usual
        count, matches = features.get(name, 0), best.get(ids.get(name), 0)
        if sharpness < BLURRED:
            reasons[name] = f"is blurred (sharpness {sharpness:.0%} of the usual)"
        elif count < FEW_FEATURES:
            reasons[name] = f"has few features ({count}): blurred, dark or plain"
        elif matches < FEW_MATCHES:
            reasons[name] = f"has few matches with any other ({matches}): too little overlap"
        else:
            reasons[name] = f"fits no others that are placed (at most {matches} matches)"
    return reasons


def _weak(database, placed):
    """The names of the images among `placed` that have no strong pair."""
    best = _most_matches(database)
    with needed("pycolmap").Database.open(database) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
    least = STRONG * np.median(list(best.values()))
    return sorted(names[i] for i, most in best.items() if most < least and names[i] in placed)


def _most_matches(database):
    """{image's id: the largest number of its matches with another image}."""
    colmap = needed("pycolmap")
    with colmap.Database.open(database) as db:
        best = {image.image_id: 0 for image in db.read_all_images()}
        for pair, matches in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            for image_id in colmap.pair_id_to_image_pair(pair):
                best[image_id] = max(best[image_id], matches)
    return best


def image_files(model: Any) -> list[ImageFile]:
    """The images of pycolmap's model that have a place, in the order of their names, as ImageFiles
    of a scene with a folder `images`.
    """
    files = []
    for image in _placed(model):
        lens = model.cameras[image.camera_id]
        focal, cx, cy, k1 = lens.params  # of features.LENS
        world = image.cam_from_world().inverse().matrix()
        camera = Camera(np.array(world), focal, focal, cx, cy, lens.width, lens.height)
        files.append(ImageFile(f"images/{image.name}", camera, lens=LensDistortion(k1)))
    return files


def points(model: Any, least: int = 2) -> tuple[np.ndarray, list[np.ndarray]]:
    """((N, 3) points of pycolmap's model that at least `least` images show, for each of
    image_files() the indices of the points in it).
    """
    chosen = [number for number, point in model.points3D.items() if point.track.length() >= least]
    index = {number: k for k, number in enumerate(chosen)}
    shown = [
        np.array([index[p.point3D_id] for p in image.points2D if p.point3D_id in index], int)
        for image in _placed(model)
    ]
    return np.array([model.points3D[number].xyz for number in chosen]), shown


def _placed(model):
    return sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)


def undistort_model(model: Any) -> None:
    """Give pycolmap's model, whose cameras are features.LENS, cameras without distortion, and move
    the points in its images accordingly.
    """
    for image in model.images.values():
        lens = image.camera
        focal, cx, cy, _ = lens.params
        directions = lens.cam_from_img(np.array([point.xy for point in image.points2D]))
        for point, place in zip(image.points2D, focal * directions + [cx, cy], strict=True):
            point.xy = place
    for lens in model.cameras.values():
        focal, cx, cy, _ = lens.params
        lens.model, lens.params = needed("pycolmap").CameraModelId.PINHOLE, [focal, focal, cx, cy]
