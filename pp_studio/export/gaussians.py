"""Gaussians of three axes fitted to a run's images, and where these are few to its renderings
of as many views between them, as viewers of 3D Gaussian splatting draw them: without a network,
each widened by a third of a pixel^2, and colours below 0 taken for black. A step draws them for a
window of another size. It is the trainer's, with the footprint "gaussian" and means of features in
place of the network.
"""

import hashlib
import json
import math
import time
import warnings
import zipfile
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Camera, Config, Progress, Run
from pp_cl.engine import (
    MIN_SIDE,
    Crop,
    Crops,
    FirstFeatures,
    Model,
    PointCloud,
    Renderer,
    Trainer,
    View,
)
from pp_cl.errors import UserError
from pp_cl.files import atomic_file
from pp_studio.camera_path import between
from pp_studio.export import BEST, QUALITIES, QUICK
from pp_studio.export.harmonics import COUNT, fit_harmonics

FILE = "gaussians.npz"  # in the folder of a run
GAUSSIAN = np.dtype(
    [
        ("position", "<f4", 3),
        ("harmonics", "<f4", (COUNT, 3)),
        ("opacity", "<f4"),
        ("deviations", "<f4", 3),
        ("turn", "<f4", 4),
    ]
)
LEAST_OPAQUE = 1 / 255  # what viewers leave out
FIRST_VIEWS = 16  # of which the points have their colours before the fit
LOW_PASS = 0.3  # pixels^2, by which they widen all on the screen

# Pixels on the longer side of the smallest window for which splats are made; in smaller ones
# viewers widen Gaussians by more than points are apart, and to try costs all others some dB.
WINDOW = 600
DOUBLINGS = 2.0  # from there to the largest
# Images that need no renderings beside them, which cost lego's 200 views 0.2 dB and give 0.3
# to the 57 of ethiopian_head.
ENOUGH = 200
LARGEST = 800  # pixels to which images are reduced, about: of more, a crop would show too little
CROP = 192  # pixels on each side of a step's crop
EARLY_STOP = 1e-4  # of viewers
# Of alpha in the loss: images are over white, on which pale Gaussians beside the object cost
# nothing; viewers have dark backgrounds, too. After 150 steps ethiopian_head has 0.3 dB more over
# black, and as much over white.
MASK_WEIGHT = 0.5
# Steps that build the kernels, after which the time of the others is known, and that a fit in some
# minutes has in any case.
BUILDING, TIMED, FEWEST = 3, 10, 40
# Of a Gaussian before it is fitted, in radii of the soft disc, whose alpha falls linearly to its
# rim: the root of its second moment. With the disc's opacity it covers 0.91 of the disc.
DEVIATION = 0.39
MOST_OPAQUE = 0.99  # what viewers clamp to
# 3D Gaussian splatting's functions of degrees 0 to 2 are basis()'s in this order, times these.
ORDER = [0, 2, 3, 1, 4, 5, 7, 6, 8]
CONSTANT = 0.28209479177387814
FACTORS = np.array(
    [
        CONSTANT,
        *(-0.4886025119029199, 0.4886025119029199, -0.4886025119029199),
        *(1.0925484305920792, -1.0925484305920792, 0.31539156525252005),
        *(-1.0925484305920792, 0.5462742152960396),
    ]
)


class Gaussians(NamedTuple):
    """A run as Gaussians that are drawn without its network, in the axes and units of its scene, as
    3D Gaussian splatting defines them.

    table: (M,) records of GAUSSIAN. position: (3,) float32, the mean, relative to the origin, (3,)
    float64. deviations: (3,) float32, standard deviations along a Gaussian's own axes (what files
    call scales, without a logarithm). turn: (4,) float32, the unit quaternion (w, x, y, z) that
    turns these axes to the world's. opacity: float32 in (1/255, 0.99], after the sigmoid.
    harmonics: (9, 3) float32, coefficients of degrees 0 to 2 for the three channels of sRGB less
    0.5, basis and signs of 3D Gaussian splatting, of the unit direction from the eye to the mean.

    windows: least and most pixels of a window, for one of the run's images each way, in which they
    look right with all variances on the screen widened by low_pass, pixels^2.
    """

    table: np.ndarray
    origin: np.ndarray
    windows: tuple[float, float] = (1.0, 1.0)
    low_pass: float = 0.0


class WindowCrops(Crops):
    """Crops as windows of any size show them: a pixel is the mean of several of a window's."""

    def __init__(self, views: list[View], config: Config):
        super().__init__(views, config.train, 0)
        longest = max(max(view.camera.width, view.camera.height) for view in views)
        self._least, self._most = windows(longest)

    def draw(self, step: int) -> Crop:
        """See Crops."""
        crop, rng = super().draw(step), np.random.default_rng((self._seed, step, 1))
        samples = self._least * (self._most / self._least) ** rng.random()
        return crop._replace(camera=replace(crop.camera, samples=samples))


def windows(longest: float) -> tuple[float, float]:
    """Least and most pixels of a window, for one pixel of images of `longest` ones, each way, of
    the windows for which Gaussians are made.
    """
    least = min(max(WINDOW / longest, 1.0), 2.0)  # from the images' own pixels to a quarter of them
    return least, least * 2**DOUBLINGS


def fit_gaussians(run: Run, steps: int, cell: float, minutes: float = math.inf) -> PointCloud:
    """Gaussians that are fitted in so many steps, or as many as take these minutes, from the points
    that training views show, those in a cubic `cell`, in voxel sizes, as one; 0: each point. Of the
    features of their SH, which are 3D Gaussian splatting's, the first three are sRGB colour.
    """
    end = time.monotonic() + 60 * minutes
    dev, cloud = run.dev, begun(run, fit_harmonics(run, steps=1), cell)  # the first of many steps
    model = Model(dev, run.model.grid, run.model.depth_range, cloud, net=FirstFeatures(dev))
    views = _fitted_views(run)
    if len(views) < ENOUGH:
        listed = run.image_files("train")
        cameras = between([one.camera for one in listed])
        more = [replace(one, camera=camera) for one, camera in zip(listed, cameras, strict=True)]
        views = (views or run.rendered(listed, opaque=False)) + run.rendered(more, opaque=False)
    sides = [side for view in views for side in (view.camera.width, view.camera.height)]
    factor = max(1, min(round(max(sides) / LARGEST), min(sides) // MIN_SIDE))
    config = config_of(run, steps)
    trainer = Trainer(dev, config, model, [one.reduced(factor * one.downscale) for one in views])
    trainer.crops = WindowCrops(trainer.views, config)
    with Progress("fitting Gaussians", steps, "step") as progress:
        while trainer.step < config.train.iterations:
            trainer.train_step()
            progress.update()
            if trainer.step == BUILDING:
                first = time.monotonic()
            if trainer.step == TIMED and minutes < math.inf:
                now = time.monotonic()
                fitting = TIMED + int((end - now) * (TIMED - BUILDING) / (now - first))
                progress.total = min(max(fitting, FEWEST), steps)
                config = replace(config, train=replace(config.train, iterations=progress.total))
                trainer.follow(config)
    trainer.check()
    trainer.finish()
    return cloud


def fitted_gaussians(run: Run, quality: str | None = None, minutes: float = math.inf) -> Gaussians:
    """The run's Gaussians, fitted once for a checkpoint and kept in the run's folder as FILE, which
    later calls read. quality: one of QUALITIES; None: what is kept, else QUICK. minutes: at most,
    which costs steps. Raises UserError as check_drawable does.
    """
    check_drawable(run)
    if found := kept_gaussians(run, [quality] if quality else QUALITIES):
        return found
    table = _table(run, fit_gaussians(run, *QUALITIES[quality or QUICK], minutes))
    try:
        with atomic_file(run.folder.path / FILE) as file:
            np.savez(file, key=np.array(_key(run, quality or QUICK)), gaussians=table)
    except UserError as error:
        warnings.warn(f"{error}; the next export fits the Gaussians again", stacklevel=2)
    return _fitted(run, table)


def kept_gaussians(run: Run, qualities: Iterable[str] = QUALITIES) -> Gaussians | None:
    """What fitted_gaussians() has kept for the run's checkpoint, if that is of one of these
    qualities and not damaged, else None.
    """
    try:
        with np.load(run.folder.path / FILE) as stored:
            key = str(stored["key"])
            is_kept = any(key == _key(run, quality) for quality in qualities)
            table = stored["gaussians"] if is_kept else np.empty(0)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return _fitted(run, table) if table.dtype == GAUSSIAN else None


def _fitted(run, table):
    longest = max(max(camera.width, camera.height) for camera in run.cameras("train"))
    reduced = max(1, round(longest / LARGEST))  # as the fit reduces them
    least, most = (one / reduced for one in windows(longest / reduced))
    return Gaussians(table, run.model.grid.centre, (least, most), LOW_PASS)


def first_gaussians(run: Run) -> Gaussians:
    """As fitted_gaussians(), but before the fit, in seconds: round, as wide as the points, with the
    means of the colours that the network gives them. Raises UserError as check_drawable does.
    """
    check_drawable(run)
    cloud = begun(run, fit_harmonics(run, steps=-1, most=FIRST_VIEWS), 0)
    return Gaussians(_table(run, cloud), run.model.grid.centre)


def _key(run, quality):
    """What the Gaussians depend on, as text."""
    cloud = run.model.cloud
    arrays = [array.get().tobytes() for array in (cloud.ids, cloud.offset, cloud.opacity)]
    digest = hashlib.sha256(b"".join(arrays)).hexdigest()
    return json.dumps([digest, run.header["step"], *QUALITIES[quality]])


def _table(run, cloud):
    """The visible ones as records of GAUSSIAN, relative to the centre of the run's grid."""
    opacity, offset = cloud.opacity.get()[:, 0].clip(0, MOST_OPAQUE), cloud.offset.get()
    rows, grid = np.flatnonzero(opacity > LEAST_OPAQUE), run.model.grid
    vertices = grid.positions(cloud.ids.get()[rows]) - grid.centre
    table = np.zeros(len(rows), GAUSSIAN)
    table["position"] = vertices + grid.voxel_size * offset[rows, :3]
    table["harmonics"] = np.concatenate([block.get()[rows, :, :3] for block in cloud.sh], axis=1)
    table["harmonics"][:, 0] -= 0.5 / CONSTANT
    table["opacity"] = opacity[rows]
    deviation = run.config.raster.radius * DEVIATION * grid.voxel_size  # of one without offsets
    lower = np.zeros((len(rows), 3, 3))  # L of the covariances L L^T, by cl/cloud.h
    lower[:, range(3), range(3)] = np.exp(offset[rows, 3:6])
    lower[:, [1, 2, 2], [0, 0, 1]] = offset[rows, 6:9]
    axes, table["deviations"], _ = np.linalg.svd(deviation * lower)
    axes[..., 2] *= np.linalg.det(axes)[:, None]  # no mirror
    table["turn"] = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)
    return table


def drawn_by(run: Run, gaussians: Gaussians) -> Run:
    """The run with its Gaussians in place of its points and network: its render() draws them as
    viewers do, for cameras of window_camera().
    """
    dev, grid, table = run.dev, run.model.grid, gaussians.table
    place = table["position"] / grid.voxel_size + (np.asarray(grid.dims) - 1) / 2
    vertices = np.rint(place).clip(0, np.asarray(grid.dims) - 1)
    ids = grid.ids(vertices.astype(np.int64))
    settings = config_of(run, FEWEST).raster
    axes = Rotation.from_quat(np.roll(table["turn"], -1, axis=1)).as_matrix()
    axes *= table["deviations"][:, None] / (settings.radius * grid.voxel_size)
    lower = np.linalg.cholesky(axes @ axes.transpose(0, 2, 1))
    offset = np.zeros((len(table), 9))
    offset[:, :3] = place - vertices
    offset[:, 3:6] = np.log(lower[:, range(3), range(3)])
    offset[:, 6:9] = lower[:, [1, 2, 2], [0, 0, 1]]
    sh = np.zeros((len(table), COUNT, 16))
    sh[..., :3] = table["harmonics"]
    sh[:, 0, :3] += 0.5 / CONSTANT
    rows = np.argsort(ids, kind="stable")
    cloud = PointCloud.of_gaussians(dev, ids[rows], offset[rows], table["opacity"][rows], sh[rows])
    model = Model(dev, grid, run.model.depth_range, cloud, net=FirstFeatures(dev))
    drawn = replace(run, model=model, config=replace(run.config, raster=settings), others=[])
    drawn.renderer, drawn.ball = Renderer(dev, model, settings), run.ball
    return drawn


def window_camera(camera: Camera, finer: float, gaussians: Gaussians) -> Camera:
    """A camera for a run of drawn_by() that shows Gaussians as the nearest window does for which
    they are made. finer: how many of its pixels there are for one of the run's images, each way.
    """
    least, _ = gaussians.windows
    return replace(camera, samples=max(1.0, least / finer))


def check_drawable(run: Run) -> None:
    """Raise UserError unless the run's points are composited by alpha, with soft footprints: no
    others are drawn without the network.
    """
    raster = run.config.raster
    if (raster.blend, raster.footprint) != ("alpha", "soft"):
        raise UserError(
            f"{run.folder.config}: raster.blend {raster.blend} with raster.footprint"
            f" {raster.footprint} can only be drawn by the run itself, unlike alpha with soft;"
            " choose another --format"
        )


def _fitted_views(run):
    """The run's training views; none if exposures differ, or, with a warning, they are gone."""
    try:
        views = [] if run.header.get("exposed") else run.scene("train").splits["train"]
    except UserError as error:
        told = f"the Gaussians are fitted to renderings of the training views alone: {error}"
        warnings.warn(told, stacklevel=2)
        return []
    return [view for view in views if view.name not in run.header.get("left_out", ())]


def begun(run: Run, coefficients: np.ndarray, cell: float) -> PointCloud:
    """The run's points as Gaussians, without those that have no coefficients (N, 9, 3) of basis().
    cell: voxel sizes; the points in a cube of them become one of their mean, covariance and colour
    that absorbs as much light. 0: none do.
    """
    dev, cloud, grid = run.dev, run.model.cloud, run.model.grid
    rows = np.flatnonzero(coefficients.any((1, 2)))
    if not len(rows):
        raise UserError(f"{run.folder}: the training views show no points; train it longer")
    ids, moved = cloud.ids.get()[rows], cloud.offset.get()[rows]
    opacity = cloud.opacity.get()[rows, 0].clip(0, MOST_OPAQUE)
    vertices = (grid.positions(ids) - grid.origin) / grid.voxel_size
    places, unit = vertices + moved[:, :3], DEVIATION * run.config.raster.radius
    area = (unit * np.exp(moved[:, 3])) ** 2  # of a round one, in voxel sizes, over 2 pi
    one = np.arange(len(rows))  # the Gaussian of a point
    if cell:
        one = np.unique(places // cell, axis=0, return_inverse=True)[1].ravel()
    count = one.max() + 1
    weight = area * opacity + 1e-6  # of those that are invisible, too, if they are alone
    total = np.bincount(one, weight, count)[:, None]

    def mean(values):
        columns = values.reshape(len(values), -1).T
        return np.stack([np.bincount(one, weight * each, count) for each in columns], 1) / total

    middle = mean(places)
    apart = places - middle[one]
    spread = mean(apart[:, :, None] * apart[:, None]).reshape(-1, 3, 3)
    spread += mean(area)[..., None] * np.eye(3)
    lengths = np.linalg.eigvalsh(spread)
    seen = np.sqrt(lengths[:, 1] * lengths[:, 2])  # as area
    absorbed = np.bincount(one, -np.log1p(-opacity) * area, count) / seen
    # Each is kept at the vertex of the first of its points, which no other has.
    first = np.unique(one, return_index=True)[1]
    order = np.argsort(ids[first])
    first, lower = first[order], np.linalg.cholesky(spread)[order] / unit
    offset = np.zeros((count, 9), np.float32)
    offset[:, :3] = middle[order] - vertices[first]
    offset[:, 3:6] = np.log(lower[:, range(3), range(3)])
    offset[:, 6:9] = lower[:, [1, 2, 2], [0, 0, 1]]
    sh = np.zeros((count, 9, 16), np.float32)
    colours = mean(coefficients[rows]).reshape(-1, 9, 3)
    sh[..., :3] = colours[order][:, ORDER] / FACTORS[:, None]
    opacity = (1 - np.exp(-absorbed[order])).clip(0, MOST_OPAQUE)
    return PointCloud.of_gaussians(dev, ids[first], offset, opacity, sh)


def config_of(run: Run, steps: int) -> Config:
    """What the trainer follows here, and how the Gaussians are drawn."""
    # Colours, which begin nearly right, would diverge with their default rates, many times these;
    # shapes have the longest way. In few steps both must go faster.
    faster = (QUALITIES[BEST][0] / steps) ** 0.25
    raster = replace(
        run.config.raster,
        footprint="gaussian",
        radius=run.config.raster.radius * DEVIATION,
        early_stop=EARLY_STOP,
        max_tracked=0,
    )
    train = replace(
        run.config.train,
        iterations=steps,
        crop=CROP,
        refine_at=(),
        supersampled=0.0,
        ema=True,
        ssim_weight=0.0,
        mask_weight=MASK_WEIGHT,
        distortion_weight=0.0,
        exposure="off",
        sh_smoothing=0.0,
        prune_weight=0.0,  # points are judged in images, where larger windows show more
        rate_steps=0,
        sh_rate=(1.2e-2 * faster, 6e-3 * faster, 3e-3 * faster),
        opacity_rate=(2.3e-2, 6.8e-3),
        offset_rate=(4e-2 * faster, 4e-3 * faster),
        view_opacity="off",  # splats have neither this
        specular="off",  # nor this
    )
    return replace(run.config, raster=raster, train=train)
