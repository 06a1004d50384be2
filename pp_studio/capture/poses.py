"""Finds where each image was taken, with pycolmap's incremental mapping, and why some images have
no place.
"""

import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Camera, Progress
from pp_cl.errors import UserError
from pp_cl.files import atomic_folder
from pp_cl.scene import ImageFile, LensDistortion
from pp_studio.capture.features import cores, forget_focal_lengths, quiet, with_zooms
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
# A lens for each image is tried if the focal length of any, with the points fixed, would differ by
# NEAR, in logarithms; zooms of LEAST_ZOOMED images or more are ZOOMED apart, of fewer LONE_ZOOMED,
# and they lower the reprojection error by ZOOM_HELPS.
NEAR, ZOOMED, LONE_ZOOMED, ZOOM_HELPS, LEAST_ZOOMED = 0.02, 0.05, 0.25, 0.05, 3
ADJUSTED = 10  # steps of an image's own focal length
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
    images without a place, half a sentence on focal lengths that differ, and the images of a turned
    object that have a place by weak pairs alone. Raises UserError if images without a place are
    more than half, and if the cameras around a turned object contradict the matches.
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
                break
            candidates.pop()  # its optimisation failed
        zoomed, of_model = "", database
        if candidates and may_be_zoomed(best):
            copy, names = unfinished / "zooms.db", [image["name"] for image in taken]
            other = _with_zooms(database, images, copy, names, turns)
            if other and other.num_reg_images() >= best.num_reg_images():
                less = other.compute_mean_reprojection_error()
                if best.num_reg_images() < least or less < (1 - ZOOM_HELPS) * error:
                    best, error, of_model, zoomed = other, less, copy, _zoom_line(other)
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
        wrong = contradictions(of_model, best) if turns else []
        (unfinished / "zooms.db").unlink(missing_ok=True)
        best.write(unfinished)
        if wrong:
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
            "zoomed": zoomed,
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


def may_be_zoomed(model: Any) -> bool:
    """Whether any image of pycolmap's model would fit better with another focal length."""
    ratios = [_focal_ratio(model, image) for image in _placed(model)]
    return bool(np.abs(np.log(ratios)).max() > NEAR)


def _with_zooms(database, images, copy, names, turns):
    """pycolmap's model of the images with these names, whose lenses are as many as they have focal
    lengths; None if that is one. copy: where the database of the model is written.
    """
    work, best, number = copy.with_suffix(""), None, {name: i for i, name in enumerate(names)}
    while True:  # a lens for each image tells which have the same
        copy.unlink(missing_ok=True)
        with_zooms(database, images, copy, number)
        work.mkdir()
        models = (_mapped_turned if turns else _mapped)(copy, images, work, len(names))
        shutil.rmtree(work)
        best = max(models, key=lambda model: model.num_reg_images(), default=None)
        if best is None:
            return None
        with Progress("refining all poses"):
            best = _refined_turned(best) if turns else refine(best)
        fewer = zooms_of(best, names)
        if fewer is None or len({*fewer.values()}) == len({*number.values()}):
            return best if fewer else None
        number = fewer


def zooms_of(model: Any, names: Sequence[str]) -> dict[str, int] | None:
    """{image: the number of its zoom}, by a model of pycolmap's with a lens for each image; None if
    all have the same. Images without a place have the zoom of most.
    """
    lengths = {i.name: np.log(model.cameras[i.camera_id].focal_length) for i in _placed(model)}
    ordered = sorted(lengths, key=lengths.__getitem__)
    steps = np.diff([lengths[name] for name in ordered]) > ZOOMED
    groups = np.split(np.array(ordered), np.flatnonzero(steps) + 1)
    large = [group for group in groups if len(group) >= LEAST_ZOOMED] or groups[:1]
    centres = np.array([np.mean([lengths[name] for name in group]) for group in large])
    numbers, lone = {}, len(large)
    for name in ordered:
        apart = np.abs(centres - lengths[name])
        numbers[name] = int(apart.argmin()) if apart.min() < LONE_ZOOMED else lone
        lone += apart.min() >= LONE_ZOOMED
    often = Counter(numbers.values()).most_common()
    return {n: numbers.get(n, often[0][0]) for n in names} if len(often) > 1 else None


def _zoom_line(model):
    """Half a sentence on the focal lengths of pycolmap's model."""
    (usual, _), *rest = Counter(image.camera_id for image in _placed(model)).most_common()
    times = {lens: model.cameras[lens].focal_length for lens, _ in rest}
    of_usual = model.cameras[usual].focal_length
    return ", ".join(
        f"{count} with {times[lens] / of_usual:.2f} times the focal length of most"
        for lens, count in rest
    )


def _focal_ratio(model, image):
    """By how much an image's own focal length is larger than its lens's, by the points of
    pycolmap's model in it: its pose and the ratio are adjusted to them. 1 if they are few.
    """
    points = [point for point in image.points2D if point.has_point3D()]
    if len(points) < FEW_MATCHES:
        return 1.0
    world = np.array([model.points3D[point.point3D_id].xyz for point in points])
    seen = model.cameras[image.camera_id].cam_from_img(np.array([point.xy for point in points]))
    matrix = image.cam_from_world().matrix()
    rotation, shift, ratio = matrix[:, :3], matrix[:, 3], 1.0
    for _ in range(ADJUSTED):
        places = world @ rotation.T + shift
        x, y, z = places.T
        off = seen - ratio * places[:, :2] / z[:, None]
        one, zero = ratio / z, np.zeros_like(z)
        by_place = np.stack(
            [np.stack([one, zero, -one * x / z], -1), np.stack([zero, one, -one * y / z], -1)], 1
        )  # (N, 2, 3)
        by_turn = np.cross(places[:, None], by_place)
        by_ratio = (places[:, :2] / z[:, None])[..., None]
        rows = np.concatenate([by_turn, by_place, by_ratio], -1)
        errors = np.linalg.norm(off, axis=1)
        usual = max(np.median(errors), 1e-9)  # 0 where points fit exactly
        weights = 1 / np.sqrt(1 + (errors / (2 * usual)) ** 2)
        step = np.linalg.lstsq(
            (rows * weights[:, None, None]).reshape(-1, 7),
            (off * weights[:, None]).ravel(),
            rcond=None,
        )[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        rotation, shift, ratio = turn @ rotation, turn @ shift + step[3:6], ratio + step[6]
    return float(max(ratio, 1e-3))  # few points may pull it below 0


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
