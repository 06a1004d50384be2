"""Fits Gaussians with three axes to a run's images and, if these are few, to the run's renderings
of as many views between them. They are drawn as viewers of 3D Gaussian splatting do: without a
network, each widened by a third of a pixel^2, and colours below 0 shown as black. Each step draws a
window of another size. The trainer is the usual one, with the footprint "gaussian" and means of
features as its network.

Harmonics of degree 2 cannot show reflections, so a specular layer is fitted to what the Gaussians
lack. Pages and films draw it; no format of splats has a place for it.
"""

import hashlib
import json
import math
import time
import warnings
import zipfile
from dataclasses import replace
from typing import Any, NamedTuple

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
    Specular,
    SpecularFit,
    Target,
    Trainer,
    evenly,
    fit_steps,
)
from pp_cl.errors import UserError
from pp_cl.files import atomic_file
from pp_studio.camera_path import between
from pp_studio.export import BEST, QUALITIES, QUICK
from pp_studio.export.harmonics import COUNT, SHARED, cubes, fit_harmonics

FILE = "gaussians.npz"  # in the folder of a run
LAYER = "specular."  # its arrays with parameters of the specular layer have names that begin so
GAUSSIAN = np.dtype(
    [
        ("position", "<f4", 3),
        ("harmonics", "<f4", (COUNT, 3)),
        ("opacity", "<f4"),
        ("deviations", "<f4", 3),
        ("turn", "<f4", 4),
    ]
)
LEAST_OPAQUE = 1 / 255  # viewers leave out Gaussians of less opacity
# views that colour the points of a preview, and those of a fit in limited minutes
FIRST_VIEWS, BEGUN_VIEWS = 16, 32
LOW_PASS = 0.3  # pixels^2 that viewers add to all variances on the screen

# Pixels on the longer side of the smallest window for which splats are made. In smaller ones
# viewers widen Gaussians by more than the points' spacing; to fit these costs all others some dB.
WINDOW = 600
DOUBLINGS = 2.0  # of the window's size, from the smallest to the largest
REFLECTING = 128  # training views that the specular layer is fitted to, at most
GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples, modulo 1, are spread evenly however many there are
# With this many images, renderings are not added: they cost lego's 200 views 0.2 dB, but give 0.3
# to the 57 of ethiopian_head.
ENOUGH = 200
LARGEST = 800  # images are reduced to about this many pixels, or a crop would show too little
CROP = 192  # pixels on each side of a step's crop
EARLY_STOP = 1e-4  # the viewers' value
# Weight of alpha in the loss. Images are over white, where pale Gaussians beside the object cost
# nothing, but viewers have dark backgrounds, too. After 150 steps ethiopian_head has 0.3 dB more
# over black, and as much as before over white.
MASK_WEIGHT = 0.5
FEWEST = 40  # steps of a fit, however little time it has
# Standard deviation of a Gaussian before the fit, in radii of the soft disc: the root of the disc's
# second moment (alpha falls linearly to its rim). With its opacity it covers 0.91 of it.
DEVIATION = 0.39
MOST_OPAQUE = 0.99  # viewers clamp to this
# 3D Gaussian splatting's functions of degrees 0 to 2: basis() in this order, times these factors.
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
    harmonics: (9, 3) float32, coefficients of degrees 0 to 2 for sRGB less 0.5, in 3D Gaussian
    splatting's basis and signs, of the unit direction from the eye to the mean.

    windows: least and most pixels of a window per pixel of the run's images, each way, for which
    they look right when low_pass, pixels^2, is added to all variances on the screen.

    specular: {name: float32 array}, the parameters of a specular layer (pp_cl.engine.Specular) that
    adds reflections to their image; None if there is none. extent: world units of 1 in its places,
    which are relative to the origin.
    """

    table: np.ndarray
    origin: np.ndarray
    windows: tuple[float, float] = (1.0, 1.0)
    low_pass: float = 0.0
    specular: dict[str, np.ndarray] | None = None
    extent: float = 1.0


class WindowCrops(Crops):
    """Crops as windows of any size show them: each pixel is the mean of several window pixels."""

    def __init__(self, *arguments: Any):
        super().__init__(*arguments)
        longest = max(max(view.camera.width, view.camera.height) for view in self.views)
        self._least, self._most = windows(longest)

    def draw(self, step: int) -> Crop:
        """See Crops."""
        crop, rng = super().draw(step), np.random.default_rng((self._seed, step, 1))
        samples = self._least * (self._most / self._least) ** rng.random()
        return crop._replace(camera=replace(crop.camera, samples=samples))


def windows(longest: float) -> tuple[float, float]:
    """The least and most window pixels per image pixel, each way, for which Gaussians are made.
    longest: the images' longest side, in pixels.
    """
    least = min(max(WINDOW / longest, 1.0), 2.0)  # 1 to 4 pixels of a window for one of an image
    return least, least * 2**DOUBLINGS


def fit_gaussians(
    run: Run, steps: int, cell: float, minutes: float = math.inf, most: float = math.inf
) -> PointCloud:
    """Fit Gaussians in `steps` steps, or as many as fit in `minutes`. They begin at the points that
    training views show. cell: voxel sizes; the points in a cube of this side begin as one, or of a
    larger one that leaves at most `most`; 0: each alone. Their SH are 3D Gaussian splatting's, with
    sRGB colour as the first three features.
    """
    began = time.monotonic()
    is_quick = minutes < math.inf  # the fit does the rest
    coefficients = fit_harmonics(run, -1 if is_quick else 1, BEGUN_VIEWS if is_quick else None)
    dev, cloud = run.dev, begun(run, coefficients, cell, most)
    model = Model(dev, run.model.grid, run.model.depth_range, cloud, net=FirstFeatures(dev))
    views = _fitted_views(run)
    if len(views) < ENOUGH:
        listed = run.image_files("train")
        cameras = between([view.camera for view in listed])
        more = [replace(view, camera=camera) for view, camera in zip(listed, cameras, strict=True)]
        views = (views or run.rendered(listed, opaque=False)) + run.rendered(more, opaque=False)
    sides = [side for view in views for side in (view.camera.width, view.camera.height)]
    factor = max(1, min(round(max(sides) / LARGEST), min(sides) // MIN_SIDE))
    config = config_of(run, steps)
    reduced = [view.reduced(factor * view.downscale) for view in views]
    trainer = Trainer(dev, config, model, reduced, crops=WindowCrops)
    prepared = time.monotonic()

    def clock(step):
        time_left = max(60 * minutes - (prepared - began), 1e-9)
        passed = (time.monotonic() - prepared) / time_left
        return max(step / steps, min(passed, step / min(FEWEST, steps)))

    trainer.clock = clock
    with Progress("fitting Gaussians", 100, "%") as progress:
        while trainer.progress < 1:
            before = trainer.progress
            trainer.train_step()
            progress.update(int(100 * trainer.progress) - int(100 * before))
    trainer.check()
    trainer.finish()
    return cloud


def fitted_gaussians(
    run: Run, quality: str | None = None, minutes: float = math.inf, most: float = math.inf
) -> Gaussians:
    """The run's Gaussians, fitted once per checkpoint and kept as FILE in the run's folder for
    later calls. quality: one of QUALITIES; None: any that is kept, limited or not, else QUICK.
    minutes, most: as in fit_gaussians(). Raises UserError as check_drawable does.
    """
    check_drawable(run)
    if gaussians := kept_gaussians(run, quality):
        return gaussians
    limited = min(minutes, most) < math.inf
    table = _table(run, fit_gaussians(run, *QUALITIES[quality or QUICK], minutes, most))
    specular = _fit_specular(run, _fitted(run, table, {}))
    stored = {LAYER + name: array for name, array in specular.items()}
    try:
        with atomic_file(run.folder.path / FILE) as file:
            key = _keys(run)[quality or QUICK, limited]
            np.savez(file, key=np.array(key), gaussians=table, **stored)
    except UserError as error:
        warnings.warn(f"{error}; the next export fits the Gaussians again", stacklevel=2)
    return _fitted(run, table, specular)


def kept_gaussians(run: Run, quality: str | None = None) -> Gaussians | None:
    """The Gaussians that fitted_gaussians() kept for the run's checkpoint in a quality, without
    limits; quality None: in any, limited or not. None if there are none or the file is damaged.
    """
    keys = _keys(run)
    allowed = [keys[quality, False]] if quality else keys.values()
    try:
        with np.load(run.folder.path / FILE) as stored:
            table = stored["gaussians"] if str(stored["key"]) in allowed else np.empty(0)
            names = [name for name in Specular.shapes() if LAYER + name in stored]
            specular = {name: stored[LAYER + name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    found = {name: (array.shape, array.dtype) for name, array in specular.items()}
    is_whole = table.dtype == GAUSSIAN and found in ({}, Specular.shapes())
    return _fitted(run, table, specular) if is_whole else None


def _fitted(run, table, specular):
    longest = max(max(camera.width, camera.height) for camera in run.cameras("train"))
    reduced = max(1, round(longest / LARGEST))  # as the fit reduces them
    least, most = (window / reduced for window in windows(longest / reduced))
    centre, extent = run.model.grid.centre, run.model.extent
    return Gaussians(table, centre, (least, most), LOW_PASS, specular or None, extent)


def _fit_specular(run, gaussians):
    """The parameters of a layer that adds what the Gaussians lack of the run's renderings of its
    training views, in windows of all sizes; {} if that does not help in views left out of the fit.
    """
    (least, most), targets = gaussians.windows, Target(run.dev)
    views = []
    for view in run.rendered(evenly(run.image_files("train"), REFLECTING), opaque=True):
        size = least * (most / least) ** (GOLDEN * len(views) % 1)
        views.append(replace(view, stored_camera=replace(view.camera, samples=size)))

    def target(i):
        camera = views[i].camera
        return targets.crop(views[i], (0, 0, camera.width, camera.height))[0]

    drawn, seed = drawn_by(run, gaussians), run.config.train.seed
    fit = SpecularFit(drawn.renderer, views, target, run.gamma, seed)
    layer = fit.fitted(fit_steps(run.config.train.iterations)).layer
    parameters = layer.parameters if layer else {}
    return {name: run.dev.download(array) for name, array in parameters.items()}


def first_gaussians(run: Run) -> Gaussians:
    """Like fitted_gaussians(), but in seconds, without a fit: round, as wide as the points, each
    with the mean of the colours that the network gives it; at most SHARED, of cubes of points if
    there are more. Raises UserError as check_drawable does.
    """
    check_drawable(run)
    cell = float(run.model.cloud.count > SHARED)
    cloud = begun(run, fit_harmonics(run, steps=-1, most=FIRST_VIEWS), cell, SHARED)
    return Gaussians(_table(run, cloud), run.model.grid.centre)


def _keys(run):
    """{(quality, whether minutes or a number limited the fit): what it depends on, as text}."""
    cloud = run.model.cloud
    arrays = [array.get().tobytes() for array in (cloud.ids, cloud.offset, cloud.opacity)]
    digest = hashlib.sha256(b"".join(arrays)).hexdigest()
    return {
        (quality, limited): json.dumps([digest, run.header["step"], *fit, limited])
        for quality, fit in QUALITIES.items()
        for limited in (False, True)
    }


def _table(run, cloud):
    """Records of GAUSSIAN for a cloud's visible Gaussians, relative to the grid's centre."""
    opacity, offset = cloud.opacity.get()[:, 0].clip(0, MOST_OPAQUE), cloud.offset.get()
    rows, grid = np.flatnonzero(opacity > LEAST_OPAQUE), run.model.grid
    vertices = grid.positions(cloud.ids.get()[rows]) - grid.centre
    table = np.zeros(len(rows), GAUSSIAN)
    table["position"] = vertices + grid.voxel_size * offset[rows, :3]
    table["harmonics"] = np.concatenate([block.get()[rows, :, :3] for block in cloud.sh], axis=1)
    table["harmonics"][:, 0] -= 0.5 / CONSTANT
    table["opacity"] = opacity[rows]
    deviation = run.config.raster.radius * DEVIATION * grid.voxel_size  # of one whose offset is 0
    lower = np.zeros((len(rows), 3, 3))  # L of the covariances L L^T, as in cl/cloud.h
    lower[:, range(3), range(3)] = np.exp(offset[rows, 3:6])
    lower[:, [1, 2, 2], [0, 0, 1]] = offset[rows, 6:9]
    axes, table["deviations"], _ = np.linalg.svd(deviation * lower)
    axes[..., 2] *= np.linalg.det(axes)[:, None]  # a rotation without reflection
    table["turn"] = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)
    return table


def drawn_by(run: Run, gaussians: Gaussians) -> Run:
    """The run with its Gaussians in place of its points and network: its render() draws them as
    viewers do, with cameras from window_camera().
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
    if gaussians.specular:
        model.specular = Specular(dev)
        for name, array in gaussians.specular.items():
            dev.write(model.specular.parameters[name], array)
    drawn = replace(run, model=model, config=replace(run.config, raster=settings), others=[])
    drawn.renderer, drawn.ball = Renderer(dev, model, settings), run.ball
    return drawn


def window_camera(camera: Camera, finer: float, gaussians: Gaussians) -> Camera:
    """A camera for drawn_by() that shows Gaussians as the nearest window for which they are made
    does. finer: pixels of the camera per pixel of the run's images, each way.
    """
    least, _ = gaussians.windows
    return replace(camera, samples=max(1.0, least / finer))


def check_drawable(run: Run) -> None:
    """Raise UserError unless the run composites its points by alpha, with soft footprints: only
    such points can be drawn without the network.
    """
    raster = run.config.raster
    if (raster.blend, raster.footprint) != ("alpha", "soft"):
        raise UserError(
            f"{run.folder.config}: raster.blend {raster.blend} with raster.footprint"
            f" {raster.footprint} can only be drawn by the run itself, unlike alpha with soft;"
            " choose another --format"
        )


def _fitted_views(run):
    """The run's training views; none if exposures differ or, with a warning, if they are gone."""
    try:
        views = [] if run.header.get("exposed") else run.scene("train").splits["train"]
    except UserError as error:
        message = f"the Gaussians are fitted to renderings of the training views alone: {error}"
        warnings.warn(message, stacklevel=2)
        return []
    return [view for view in views if view.name not in run.header.get("left_out", ())]


def begun(run: Run, coefficients: np.ndarray, cell: float, most: float = math.inf) -> PointCloud:
    """The run's points as Gaussians, except those without coefficients (N, 9, 3) of basis(). cell,
    most: as in fit_gaussians(); the points in a cube become one Gaussian of their mean, covariance
    and colour that absorbs as much light.
    """
    dev, cloud, grid = run.dev, run.model.cloud, run.model.grid
    rows = np.flatnonzero(coefficients.any((1, 2)))
    if not len(rows):
        raise UserError(f"{run.folder}: the training views show no points; train it longer")
    ids, moved = cloud.ids.get()[rows], cloud.offset.get()[rows]
    opacity = cloud.opacity.get()[rows, 0].clip(0, MOST_OPAQUE)
    vertices = (grid.positions(ids) - grid.origin) / grid.voxel_size
    places, unit = vertices + moved[:, :3], DEVIATION * run.config.raster.radius
    area = (unit * np.exp(moved[:, 3])) ** 2  # area of a round one, in voxel sizes, over 2 pi
    # the Gaussian of each point
    group = cubes(places, cell, most) if cell else np.arange(len(rows))
    count = group.max() + 1
    weight = area * opacity + 1e-6  # above 0, also for a lone invisible point
    total = np.bincount(group, weight, count)[:, None]

    def mean(values):
        columns = values.reshape(len(values), -1).T
        return np.stack([np.bincount(group, weight * each, count) for each in columns], 1) / total

    middle = mean(places)
    apart = places - middle[group]
    spread = mean(apart[:, :, None] * apart[:, None]).reshape(-1, 3, 3)
    spread += mean(area)[..., None] * np.eye(3)
    lengths = np.linalg.eigvalsh(spread)
    merged_area = np.sqrt(lengths[:, 1] * lengths[:, 2])  # area over 2 pi of the merged one
    absorbed = np.bincount(group, -np.log1p(-opacity) * area, count) / merged_area
    # Each Gaussian is kept at the vertex of its first point, which no other one has.
    first = np.unique(group, return_index=True)[1]
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
    """The settings with which Gaussians are trained and drawn here."""
    # Colours begin nearly right and would diverge at their default rates, which are many times
    # these; shapes have the farthest to go. With few steps both must go faster.
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
        depth_weight=0.0,
        exposure="off",
        sh_smoothing=0.0,
        prune_weight=0.0,  # images judge points, but larger windows show more
        rate_steps=0,
        sh_rate=(1.2e-2 * faster, 6e-3 * faster, 3e-3 * faster),
        opacity_rate=(2.3e-2, 6.8e-3),
        offset_rate=(4e-2 * faster, 4e-3 * faster),
        view_opacity="off",  # splats have no such term
        specular="off",  # nor this one
    )
    return replace(run.config, raster=raster, train=train)
