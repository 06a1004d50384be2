"""Gaussians of three axes fitted to a run's images, and where these are few to its renderings
of as many views between them, as viewers of 3D Gaussian splatting draw them: without a network,
each widened by a third of a pixel^2, and colours below 0 taken for black.

The trainer does it, with the footprint "gaussian" and means of features in place of the network.
"""

from __future__ import annotations

import copy
import hashlib
import json
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Config, Run, track
from pp_cl.engine import MIN_SIDE, Crop, Crops, Means, Model, PointCloud, Trainer, View
from pp_cl.errors import UserError
from pp_cl.files import atomic_file
from pp_studio.camera_path import between
from pp_studio.export import WINDOW
from pp_studio.export.harmonics import COUNT, fit_harmonics

FILE = "gaussians.npz"  # in the folder of a run
# Of a Gaussian, see fitted_gaussians()
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

STEPS = 7000
# Of the steps of windows larger than the images, those that draw renderings as large as these, each
# pixel as if it were the mean of a viewer's: nearly right, and they see as much more of an image.
COARSE = 0.7
# Images that need no renderings beside them, which cost lego's 200 views 0.2 dB and give 0.3
# to the 57 of ethiopian_head.
ENOUGH = 200
CROP, LEAST_CROP = 192, 16  # pixels on each side of a step's crop: of what is drawn, of an image
EARLY_STOP = 1e-4  # of viewers
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


class LargeCrops(Crops):
    """Crops whose cameras have `scale` times the pixels each way, each the mean of as many of a
    window's as make `samples` of them a pixel of the image.
    """

    def __init__(self, views: list[View], config: Config, scale: int, samples: float):
        super().__init__(views, replace(config.train, crop=CROP // scale), 0)
        self.scale, self.samples = scale, samples / scale

    def draw(self, step: int) -> Crop:
        """See Crops."""
        crop = super().draw(step)
        size = crop.camera.width * self.scale, crop.camera.height * self.scale
        camera = replace(crop.camera.resized(*size), samples=self.samples)
        return crop._replace(camera=camera)


def fit_gaussians(run: Run, window: int) -> tuple[PointCloud, float]:
    """(the points that training views show, as Gaussians, the deviation of one without offsets):
    fitted to renderings of about `window` pixels on the longer side. Of the features of their SH,
    which are 3D Gaussian splatting's, the first three are sRGB colour.
    """
    dev, coefficients = run.dev, fit_harmonics(run, steps=1)  # the first of many steps
    cloud, net = _cloud(run, coefficients), Means(dev)
    model = Model(dev, run.model.grid, run.model.depth_range, cloud, net=net)
    views = _fitted_views(run)
    if len(views) < ENOUGH:
        listed = run.image_files("train")
        cameras = between([one.camera for one in listed])
        more = [replace(one, camera=camera) for one, camera in zip(listed, cameras, strict=True)]
        views = (views or run.rendered(listed, opaque=True)) + run.rendered(more, opaque=True)
    sides = [side for view in views for side in (view.camera.width, view.camera.height)]
    factor = max(1, min(round(max(sides) / window), min(sides) // MIN_SIDE))
    views = [view.reduced(factor * view.downscale) for view in views]
    longest = max(sides) / factor
    samples = max(1.0, window / longest)
    scale = min(int(samples), CROP // LEAST_CROP)
    config = _config(run.config, scale)
    trainer = Trainer(dev, config, model, views)
    steps = config.train.iterations
    for step in track(range(steps), "fitting Gaussians", "step"):
        if step in (0, round(COARSE * steps)):
            net.scale = scale if step else 1
            trainer.crops = LargeCrops(trainer.views, config, net.scale, samples)
        trainer.train_step()
    trainer.check()
    trainer.finish()
    return cloud, config.raster.radius * run.model.grid.voxel_size


def fitted_gaussians(run: Run, window: int = WINDOW) -> tuple[np.ndarray, np.ndarray]:
    """((M,) records of GAUSSIAN, (3,) float64 origin): the run as Gaussians that are drawn without
    its network, in the axes and units of its scene, as 3D Gaussian splatting defines them.

    position: (3,) float32, the mean, relative to the origin. deviations: (3,) float32, standard
    deviations along a Gaussian's own axes (what files call scales, without a logarithm). turn: (4,)
    float32, the unit quaternion (w, x, y, z) that turns these axes to the world's. opacity: float32
    in (1/255, 0.99], after the sigmoid. harmonics: (9, 3) float32, coefficients of degrees 0 to 2
    for the three channels of sRGB less 0.5, basis and signs of 3D Gaussian splatting, of the unit
    direction from the eye to the mean.

    Fitted once for a checkpoint and kept in the run's folder as FILE; later calls read that. Raises
    UserError as check_drawable does.
    """
    check_drawable(run)
    path, origin = run.folder.path / FILE, run.model.grid.centre
    key = _key(run, window)
    table = _kept(path, key)
    if table is None:
        table = _table(run, *fit_gaussians(run, window))
        try:
            with atomic_file(path) as file:
                np.savez(file, key=np.array(key), gaussians=table)
        except UserError as error:
            warnings.warn(f"{error}; the next export fits the Gaussians again", stacklevel=2)
    return table, origin


def _key(run, window):
    """What the Gaussians depend on, as text."""
    cloud, digest = run.model.cloud, hashlib.sha256()
    for array in (cloud.ids, cloud.offset, cloud.opacity):
        digest.update(array.get().tobytes())
    return json.dumps([digest.hexdigest(), run.header["step"], window, STEPS])


def _kept(path: Path, key: str) -> np.ndarray | None:
    """The Gaussians of a file that has this key, None where there is none or it is damaged."""
    try:
        with np.load(path) as stored:
            table = stored["gaussians"] if str(stored["key"]) == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return table if table is not None and table.dtype == GAUSSIAN else None


def _table(run, cloud, deviation):
    """The visible ones as records of GAUSSIAN, relative to the centre of the run's grid."""
    opacity, offset = cloud.opacity.get()[:, 0].clip(0, MOST_OPAQUE), cloud.offset.get()
    rows, grid = np.flatnonzero(opacity > LEAST_OPAQUE), run.model.grid
    vertices = grid.positions(cloud.ids.get()[rows]) - grid.centre
    table = np.zeros(len(rows), GAUSSIAN)
    table["position"] = vertices + grid.voxel_size * offset[rows, :3]
    table["harmonics"] = np.concatenate([block.get()[rows, :, :3] for block in cloud.sh], axis=1)
    table["harmonics"][:, 0] -= 0.5 / CONSTANT
    table["opacity"] = opacity[rows]
    axes, table["deviations"], _ = np.linalg.svd(deviation * triangles(offset[rows]))
    axes[..., 2] *= np.linalg.det(axes)[:, None]  # no mirror
    table["turn"] = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)
    return table


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


def triangles(offset: np.ndarray) -> np.ndarray:
    """(N, 3, 3) L of the covariances L L^T of Gaussians, in deviations of one without offsets.
    offset: (N, 16), cl/cloud.h.
    """
    lower = np.zeros((len(offset), 3, 3))
    lower[:, range(3), range(3)] = np.exp(offset[:, 3:6])
    lower[:, [1, 2, 2], [0, 0, 1]] = offset[:, 6:9]
    return lower


def _fitted_views(run):
    """The run's training views, none if their exposures differ, or with a warning if they are not
    there.
    """
    if run.header.get("exposed"):
        return []
    try:
        views = run.scene("train").splits["train"]
    except UserError as error:
        told = f"the Gaussians are fitted to renderings of the training views alone: {error}"
        warnings.warn(told, stacklevel=2)
        return []
    return [view for view in views if view.name not in run.header.get("left_out", ())]


def _cloud(run, coefficients):
    """A copy of the run's points, those that have no coefficients (N, 9, 3) of basis() left out."""
    dev, cloud = run.dev, run.model.cloud
    rows = np.flatnonzero(coefficients.any((1, 2)))
    if not len(rows):
        raise UserError(f"{run.folder}: the training views show no points; train it longer")
    offset = np.zeros((len(rows), 9), np.float32)
    given = cloud.offset.get()[rows]
    offset[:, :3], offset[:, 3:6] = given[:, :3], given[:, 3:]  # round, as large as the points
    sh = np.zeros((len(rows), 9, 16), np.float32)
    sh[..., :3] = coefficients[rows][:, ORDER] / FACTORS[:, None]
    opacity = cloud.opacity.get()[rows, 0].clip(0, MOST_OPAQUE)
    return PointCloud.of_gaussians(dev, cloud.ids.get()[rows], offset, opacity, sh)


def _config(given: Config, scale: int) -> Config:
    """What the trainer follows here, for renderings of about `scale` times the images each way."""
    config = copy.deepcopy(given)
    raster, train = config.raster, config.train
    raster.footprint, raster.early_stop, raster.max_tracked = "gaussian", EARLY_STOP, 0
    raster.radius *= DEVIATION
    train.iterations = STEPS
    train.crop, train.refine_at, train.ema = CROP, (), True
    train.mask_weight = train.distortion_weight = train.sh_smoothing = 0.0
    train.exposure, train.ssim_weight = "off", 0.0
    # Colours, which begin nearly right, would diverge with their default rates, seventeen times
    # these and more; shapes have the longest way. In renderings as large as the images colours must
    # be fast, since they sharpen what viewers widen; in larger ones slower colours and faster
    # opacities are better (0.4 dB on lego by the colours alone).
    train.rate_steps = 0
    if scale == 1:
        train.sh_rate, train.opacity_rate = (3e-2, 1.5e-2, 7.5e-3), (7.6e-3, 2.3e-3)
    else:
        train.sh_rate, train.opacity_rate = (1.2e-2, 6e-3, 3e-3), (2.3e-2, 6.8e-3)
        train.prune_weight = 0.0  # points are judged in images, where larger renderings show more
    train.offset_rate, train.lobe_rate = (4e-2, 4e-3), 0.0
    return config
