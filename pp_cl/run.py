"""A trained model in the folder of a run: load it, render any camera, evaluate it on views."""

import math
import os
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from pp_cl.config import Config, configure, load_config
from pp_cl.device.device import Device
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import check_target, remove_leftovers, write_json
from pp_cl.files.contact_sheet import write_comparison
from pp_cl.files.image import to_8bit, write_png
from pp_cl.files.manifest import begin_manifest, check_ours, has_manifest, remove_ours
from pp_cl.files.picture import Picture, mean_picture
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.psnr_ssim import Metrics, exposed_alike, mean
from pp_cl.metrics.published import differences, published_rows
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.render import Renderer
from pp_cl.scene.camera import Camera
from pp_cl.scene.identity import difference, kept_views, learned
from pp_cl.scene.load import DEMO, Scene, open_scene, scene_frames
from pp_cl.scene.target import Target
from pp_cl.scene.views import Photograph, View
from pp_cl.training.checkpoint import load_run_state
from pp_cl.training.schedule import gamma_at

COMPARED_VIEWS = 2  # training photographs that tell whether a scene is the run's
NEAREST = 0.05  # of a point to the eye, in radii of the object


@dataclass
class Run:
    """The model of a run's last checkpoint. header: of the checkpoint, see files/run_folder.py."""

    dev: Device
    folder: RunFolder
    config: Config
    header: dict[str, Any]
    model: Model

    @cached_property
    def renderer(self) -> Renderer:
        """Renders the model, whose parameters must not change any more."""
        self.model.net.freeze()
        return Renderer(self.dev, self.model, self.config.raster)

    @property
    def gamma(self) -> float:
        """Depth sharpness of the blend at the run's last step."""
        # the settings of a finished run that is extended say where it goes, not where it is
        steps = self.config.train.iterations
        return gamma_at(steps if self.header["finished"] else self.header["step"], steps)

    def scene(self, split: str) -> Scene:
        """The run's scene with one split. Raises UserError where it is missing, broken or another
        one than the run has learned.
        """
        check_scene(self.config.scene.path)
        scene = open_scene(self.dev, self.config, (split,))
        self._compare(lambda: scene.splits.get("train") or self._some_photographs())
        return scene

    def _some_photographs(self):
        if not self.header["pixels"]:
            return []
        return open_scene(self.dev, self.config, ("train",), COMPARED_VIEWS).splits["train"]

    def _compare(self, read):
        """Raise UserError unless the scene's training views are those of the run. read: gives those
        whose pixels are compared, too.
        """
        path, header = self.config.scene.path, self.header
        try:
            views = read()
            told = difference(header, scene_frames(path), views)
            if told:  # else views were dropped or taken back since, which changes no result
                listed = learned(header, scene_frames(path, edited=False))
                told = difference(header, listed, views)
        except UserError as error:
            warnings.warn(
                f"{path}: cannot be compared with the scene of {self.folder} ({error})",
                stacklevel=3,
            )
            return
        if told:
            raise UserError(
                f"{self.folder.checkpoint}: belongs to another scene than {path} ({told}); say"
                " where its own is with --scene"
            )

    def photographs(self, split: str) -> list[Photograph]:
        """A split's views without their pixels. The run itself keeps those of train; for others
        raises UserError where the scene is missing, broken, or another one by names and cameras.
        """
        if split == "train":
            return kept_views(self.header["views"])
        check_scene(self.config.scene.path)
        listed = scene_frames(self.config.scene.path, split)
        self._compare(list)
        return listed

    def cameras(self, split: str = "test") -> list[Camera]:
        """The cameras of a split's views at the resolution of the run. Raises UserError where the
        scene is not there.
        """
        downscale = self.config.scene.downscale
        return [one.camera.downscaled(downscale) for one in self.photographs(split)]

    def rendered(self, photographs: Sequence[Photograph], *, opaque: bool) -> list[View]:
        """Views at the resolution of the run whose images are its own renderings. opaque: over
        white, as it was trained; else straight RGBA. A progress bar shows on a terminal.
        """
        views = []
        for one in tqdm(photographs, "rendering", unit="view", leave=False, disable=None):
            camera = one.camera.downscaled(self.config.scene.downscale)
            picture = self.render(camera)
            image = _over_white(picture) if opaque else picture.rgba()
            views.append(View(one.name, camera, to_8bit(image), one.depth_range))
        return views

    @cached_property
    def ball(self) -> tuple[np.ndarray, float]:
        """(centre (3,), radius), world units, of the smallest ball around the middle of the box of
        the points that holds them all.
        """
        points = self.model.positions()
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = np.linalg.norm(points - centre, axis=1).max() + self.model.grid.edge
        return centre, float(radius)

    def render(self, camera: Camera, *, samples: int = 1, features: bool = False) -> Picture:
        """The model as the camera sees it. samples: it is the mean of so many images, a square
        number, shifted by fractions of a pixel. features: with the network's input. Raises
        ValueError for another number of samples, UserError where the image holds NaN.
        """
        side = math.isqrt(samples)
        if samples < 1 or side * side != samples:
            raise ValueError(f"{samples} samples are no square number")
        shifts = (np.arange(side) + 0.5) / side - 0.5
        depths = self.depth_range(camera)
        picture = mean_picture(
            self.renderer.picture(
                camera.shifted(dx, dy), self.gamma, features=features, depth_range=depths
            )
            for dy in shifts
            for dx in shifts
        )
        self.checked(picture.colour)
        return picture

    def checked(self, image: np.ndarray) -> np.ndarray:
        """An image of the run. Raises UserError naming the checkpoint where it holds NaN: finite
        parameters may be too large to compute with.
        """
        if np.isnan(image).any():
            raise UserError(
                f"{self.folder.checkpoint}: its parameters are too large, the image holds NaN;"
                " restore a copy, or train again with a lower network.rate or train.sh_rate"
            )
        return image

    def depth_range(self, camera: Camera) -> tuple[float, float] | None:
        """(near, far) of a camera anywhere; None, the model's, where the blend depends on it."""
        if self.config.raster.blend == "softmax":
            return None
        centre, radius = self.ball
        distance = float(np.linalg.norm(camera.eye - centre))
        return max(distance - radius, NEAREST * radius), distance + radius


def _over_white(picture):
    return np.pad(picture.colour, ((0, 0), (0, 0), (0, 1)), constant_values=1)


def scene_is_there(path: str) -> bool:
    """Whether a run's scene can be read, or made by the program."""
    return path == DEMO or Path(path).is_dir()


def check_scene(path: str) -> None:
    """Raise UserError where the folder of a run's scene is not there."""
    if not scene_is_there(path):
        raise UserError(f"{path}: the run's scene is not there; say where with --scene")


def stored_config(folder: RunFolder, scene: str | None = None) -> Config:
    """The settings of a run. scene: the folder of its scene, if that has moved. Raises UserError
    where either is missing or broken.
    """
    if scene is not None:
        check_scene(scene)
    config = load_config(folder.config)
    return configure(config, scene or config.scene.path)


def load_run(dev: Device, folder: Path | str, *, scene: str | None = None) -> Run:
    """The run in a folder, finished or not. scene: the folder of its scene, if that has moved.
    Raises UserError naming the file that is missing or broken.
    """
    place = RunFolder(folder)
    config = stored_config(place, scene)
    header, arrays = load_run_state(place, config)
    net = UNet.of_settings(dev, config.network)
    model = Model.load(dev, header, arrays, net, degree=config.points.sh_degree)
    return Run(dev, place, config, header, model)


def load(folder: Path | str, device: str | None = None, *, scene: str | None = None) -> Run:
    """The run in a folder, finished or not. device: as `pp-cl devices` lists them, else the default
    one. scene: the folder of its scene, if that has moved. Raises UserError naming the file that is
    missing or broken.
    """
    return load_run(open_device(device), folder, scene=scene)


SHOWN_VIEWS = 4  # rows of the comparison image
MOVE = "move it away, or choose another --out"


class Rendered(NamedTuple):
    """A view as the run renders it.

    image, truth: (H, W, 3) float32 in [0, 1]. alpha: (H, W) of the truth. computed: fraction of the
    network's multiplications that were computed; the others would have seen background alone.
    """

    name: str
    image: np.ndarray
    truth: np.ndarray
    alpha: np.ndarray
    seconds: float
    computed: float


def evaluate_run(
    folder: Path | str,
    split: str = "test",
    metrics: tuple[str, ...] = ("psnr", "ssim"),
    *,
    save_images: bool = False,
    device: str | None = None,
    scene: str | None = None,
    out: Path | str | None = None,
) -> dict[str, Any]:
    """Measure the run in a folder as `pp-cl eval` does, into `out`, else into its own folder;
    returns what metrics.json holds. metrics: out of psnr, ssim, lpips. save_images: write every
    view, too. device, scene: as load() takes them.
    """
    run = load(folder, device, scene=scene)
    return evaluate(run, split, metrics, save_images=save_images, out=out)


def evaluate(
    run: Run,
    split: str,
    metrics: tuple[str, ...],
    *,
    save_images: bool = False,
    out: Path | str | None = None,
) -> dict[str, Any]:
    """Measure a run; writes metrics.json and comparison.png into the folder `out`, if not given
    RUN/eval, or RUN/eval/SPLIT for other splits than test, and returns the former. Where the
    run's photographs had gains, views are also measured after the best ones, exposed_alike().

    metrics: names out of psnr, ssim, lpips. save_images: write every view to images/ there, in
    place of what an earlier evaluation left. A progress bar shows on a terminal. Raises UserError
    for a missing or broken split, a folder that may not be written, an `out` that holds something
    else than an evaluation, and a file in the place of one that it writes which no evaluation has
    written as it is now.
    """
    target = run.folder.evaluation(split) if out is None else Path(out)
    _check_target(target, is_new=out is not None)
    scene = run.scene(split)
    views = scene.splits[split]
    images = [target / "images" / file for file in image_files([view.name for view in views])]
    if save_images:
        check_ours(images, MOVE)
    measure = Metrics(run.dev, metrics)
    begin_manifest(target)
    remove_leftovers(target)
    if save_images:
        remove_ours((target / "images").rglob("*"))
    rows: list[dict[str, Any]] = []
    costs, shown = [], []
    every = render_views(run, views)
    bar = tqdm(every, "measuring", len(views), unit="view", leave=False, disable=None)
    for i, rendered in enumerate(bar):
        image, truth = rendered.image, rendered.truth
        rows.append({"name": rendered.name} | measure(image, truth))
        if "exposed" in run.header:
            matched = exposed_alike(truth, image, rendered.alpha)
            rows[-1]["after_gains"] = measure(image, matched)
        costs.append((rendered.seconds, rendered.computed))
        if i in {len(views) * row // SHOWN_VIEWS for row in range(SHOWN_VIEWS)}:
            shown.append((image, truth))
        if save_images:
            images[i].parent.mkdir(parents=True, exist_ok=True)
            write_png(images[i], image)
    means = mean([{name: row[name] for name in metrics} for row in rows])
    result = {"split": split, "device": run.dev.name, "mean": means, "per_image": rows}
    if "exposed" in run.header:
        result["mean_after_gains"] = mean([row["after_gains"] for row in rows])
    result |= _about(run, costs) | _published(scene, split, views)
    write_json(target / "metrics.json", result)
    write_comparison(target / "comparison.png", *zip(*shown, strict=True))
    return result


def _check_target(target, *, is_new):
    """Raise UserError where an evaluation cannot be written into a folder. is_new: nor if it holds
    files and no evaluation.
    """
    if target.exists() and not target.is_dir():
        raise UserError(f"{target}: is not a folder; choose another --out")
    check_target(target / "metrics.json")
    if is_new and target.exists() and not has_manifest(target) and any(target.iterdir()):
        raise UserError(f"{target}: holds other files; choose a new or empty folder for --out")
    check_ours([target / "metrics.json", target / "comparison.png"], MOVE)


def _published(scene, split, views):
    """{"published": rows of the scene, "published_differs": how this measurement differs from
    them}.
    """
    cameras = [view.file_camera for view in views]
    rows = published_rows(scene.name, cameras)
    differs = differences(scene.name, cameras, views[0].file_downscale, split) if rows else ""
    return {"published": rows, "published_differs": differs}


def _about(run, costs):
    """What metrics.json says of the run. costs: [(seconds, fraction computed)] of each view."""
    seconds, computed = zip(*costs, strict=True)
    return {
        "step": run.header["step"],
        "finished": run.header["finished"],
        "points": {
            "initial": run.header["initial_points"],
            "final": run.model.cloud.count,
            "grid": run.header["grid"]["dims"],
        },
        "seconds_per_frame": float(np.median(seconds)),
        "computed_fraction": float(np.mean(computed)),
    }


def image_files(names: list[str]) -> list[PurePosixPath]:
    """Relative paths of PNG files for views of these names: the folders in which they differ stay,
    those that all of them share go.
    """
    paths = [PurePosixPath(name) for name in names]
    shared = os.path.commonpath([path.parent for path in paths])
    paths = [path.relative_to(shared) for path in paths]
    files = [path.with_suffix(".png") for path in paths]
    if len(set(files)) < len(files):  # a.jpg beside a.png
        files = [path.with_name(f"{path.name}.png") for path in paths]
    return files


def render_views(run: Run, views: list[View]) -> Iterator[Rendered]:
    """Each view as the run renders it, in turn."""
    target = Target(run.dev)
    run.render(views[0].camera)  # builds the programs
    for view in views:
        start = time.perf_counter()
        result = run.renderer.forward(view.camera, run.gamma)
        image, computed = run.checked(result.clamped()), result.computed_fraction
        seconds = time.perf_counter() - start
        del result  # else its arrays would stay beside the larger ones of the next view
        whole = target.crop(view, (0, 0, view.camera.width, view.camera.height))
        truth, alpha = (array.get() for array in whole)
        truth = view.ignoring(truth, image)
        yield Rendered(view.name, image, truth, alpha, seconds, computed)
