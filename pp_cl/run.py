"""A trained model in the folder of a run: loads it and renders any camera."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.checkpoint import load_run_state, progress_of
from pp_cl.config import configure, load_config
from pp_cl.drivers import open_device
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.depth import depth_forward
from pp_cl.engine.raster.footprint import MOST_OFFSET
from pp_cl.engine.render import Renderer, RenderResult
from pp_cl.engine.stored import load_model
from pp_cl.engine.training.schedule import gamma_at, supersampling_at
from pp_cl.engine.views import View
from pp_cl.errors import UserError, few_names
from pp_cl.files.image import to_8bit
from pp_cl.files.rendered_view import RenderedView, mean_rendered_view
from pp_cl.files.run_folder import MADE, RunFolder
from pp_cl.progress import track
from pp_cl.scene.hull import misplaced
from pp_cl.scene.identity import difference, unpacked_views
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.listing import DEMO, list_split, scene_format, scene_frames
from pp_cl.scene.load import Scene, open_scene
from pp_cl.settings import Config

COMPARED_VIEWS = 2  # training images whose pixels show whether a scene is the run's
NEAREST = 0.05  # distance of drawn points from the eye, in radii of the object
# Pixels rendered around an image. Without them, the corner of a white background has 227 of 255;
# four more change no pixel by 0.2 of 255, and an image of 200 pixels takes 8 % longer.
MARGIN = 4


@dataclass
class Run:
    """The model of a run's last checkpoint, and that checkpoint's header. others: further members;
    the run shows the mean of all members' images.
    """

    dev: Device
    folder: RunFolder
    config: Config
    header: dict[str, Any]
    model: Model
    others: list["Run"] = field(default_factory=list)

    @cached_property
    def renderer(self) -> Renderer:
        """A renderer of the model, whose parameters must no longer change."""
        self.model.net.freeze()
        supersampling = supersampling_at(self.progress, self.config.train)
        return Renderer(self.dev, self.model, self.config.raster, supersampling, MARGIN)

    def varied(
        self,
        *,
        rows: np.ndarray | None = None,
        early_stop: float | None = None,
        supersampling: int | None = None,
        has_specular: bool = True,
        net: UNet | None = None,
        others: Sequence["Run"] | None = None,
    ) -> "Run":
        """A run that shows the same but for what is given. rows: (M,) uint32, ascending, its only
        points. early_stop: of raster. supersampling: of Renderer. has_specular: whether the
        specular layer is applied, where there is one. net: computes the same by other kernels.
        others: in place of the further members.
        """
        dev, model, raster = self.dev, self.model, self.config.raster
        cloud = model.cloud if rows is None else model.cloud.rows(dev, dev.upload(rows))
        if early_stop is not None:
            raster = replace(raster, early_stop=early_stop)
        shown = Model(
            dev,
            model.grid,
            model.depth_range,
            cloud,
            net=net or model.net,
            specular=model.specular if has_specular else None,
        )
        members = self.others if others is None else [*others]
        config = replace(self.config, raster=raster)
        run = replace(self, model=shown, config=config, others=members)
        # what a member shows of a view does not depend on which points are left out
        run.ball = self.ball
        samples = supersampling or self.renderer.supersampling
        run.renderer = Renderer(dev, shown, raster, samples, self.renderer.margin)
        if net:
            net.freeze()
        return run

    @property
    def progress(self) -> float:
        """The progress of the training, from 0 to 1."""
        return progress_of(self.header, self.config.train.iterations)

    @property
    def gamma(self) -> float:
        """The depth sharpness of the blend at the run's last step."""
        return gamma_at(self.progress)

    def scene(self, split: str, side: int = 0) -> Scene:
        """The run's scene with one split, without views that training has left out or that show
        another place. side: pixels of its views' longer side; 0: as in the training. Raises
        UserError if it is missing, broken or not the run's scene, or if images are smaller.
        """
        check_scene(self.config.scene.path)
        config = self.config
        if side:
            listed = list_split(config.scene.path, split, edited=False).image_files
            longest = [max(file.camera.width, file.camera.height) for file in listed]
            if min(longest) < side:
                raise UserError(
                    f"--size {side}: {listed[longest.index(min(longest))].name} has"
                    f" {min(longest)} pixels; choose a size up to {min(longest)}"
                )
            config = replace(config, scene=replace(config.scene, downscale=min(longest) // side))
        scene = open_scene(self.dev, config, (split,))
        if side:
            views = [view.of_size(side) for view in scene.splits[split]]
            scene = replace(scene, splits={split: views})

        def trained():
            if "train" in scene.splits or not self.header["pixels"]:
                return scene.splits.get("train", [])
            return open_scene(self.dev, self.config, ("train",), COMPARED_VIEWS).splits["train"]

        self._compare(trained)
        views, gone = scene.splits[split], set(self.header.get("left_out", []))
        gone |= {v.name for v in misplaced(self.model.grid, self.model.cloud.ids.get(), views)}
        kept = [view for view in views if view.name not in gone]
        if len(kept) == len(views):
            return scene
        names = few_names([view.name for view in views if view.name in gone])
        text = f"{split}: {len(views) - len(kept)} of {len(views)} views left out: their masks"
        text += f" miss the model ({names})"
        warnings.warn(f"{self.config.scene.path}: {text}", stacklevel=2)
        return replace(scene, splits={split: kept}, notes=[*scene.notes, text])

    def _compare(self, read):
        """Raise UserError unless the training views are the run's. read() gives the views whose
        pixels are compared, too.
        """
        path, header = self.config.scene.path, self.header
        try:
            views = read()
            # views dropped or restored since training do not change the result
            differs = difference(header, list_split(path, edited=False).image_files, views)
        except UserError as error:
            warnings.warn(
                f"{path}: cannot be compared with the scene of {self.folder} ({error})",
                stacklevel=3,
            )
            return
        if differs:
            raise UserError(
                f"{self.folder.checkpoint}: belongs to another scene than {path} ({differs}); say"
                " where its own scene is with --scene"
            )

    def image_files(self, split: str) -> list[ImageFile]:
        """A split's views without their pixels. The run stores those of train; for other splits,
        raises UserError if the scene is missing or broken, or has other names or cameras.
        """
        if split == "train":
            return unpacked_views(self.header["views"])
        check_scene(self.config.scene.path)
        listed = scene_frames(self.config.scene.path, split)
        self._compare(list)
        return listed

    def cameras(self, split: str = "test") -> list[Camera]:
        """The cameras of image_files(), at the run's resolution. Raises UserError."""
        downscale = self.config.scene.downscale
        return [image_file.camera.downscaled(downscale) for image_file in self.image_files(split)]

    def rendered(self, image_files: Sequence[ImageFile], *, opaque: bool) -> list[View]:
        """Views at the run's resolution whose images are its own renderings. opaque: over white, as
        in training; otherwise straight RGBA.
        """
        views = []
        for image_file in track(image_files, "rendering", "view"):
            camera = image_file.camera.downscaled(self.config.scene.downscale)
            rendered = self.render(camera)
            white = np.dstack([rendered.colour, np.ones_like(rendered.alpha)])
            image = white if opaque else rendered.rgba()
            views.append(View(image_file.name, camera, to_8bit(image), image_file.depth_range))
        return views

    @cached_property
    def ball(self) -> tuple[np.ndarray, float]:
        """(centre (3,), radius) of the smallest ball around the middle of the points' box that
        holds all points.
        """
        points = self.model.positions()
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = np.linalg.norm(points - centre, axis=1).max() + self.model.grid.voxel_size
        return centre, float(radius)

    def render(
        self,
        camera: Camera,
        *,
        samples: int = 1,
        features: bool = False,
        early_stop: float | None = None,
        supersampling: int | None = None,
    ) -> RenderedView:
        """The model as the camera sees it. samples: a square number of images, shifted by fractions
        of a pixel, whose mean is taken. features: add the network's input. early_stop: replaces
        raster.early_stop. supersampling: 1 or 2, samples along each side of a pixel; None: as in
        the training. Raises ValueError if samples is not a square number, UserError if the image
        holds NaN.
        """
        side = math.isqrt(samples)
        if samples < 1 or side * side != samples:
            raise ValueError(f"{samples} samples: must be a square number")
        shifts = (np.arange(side) + 0.5) / side - 0.5
        options: dict[str, Any] = {"early_stop": early_stop, "supersampling": supersampling}
        options["depth_range"] = self.depth_range(camera)

        def sample(dx, dy):
            result = self.renderer.forward(camera.shifted(dx, dy), self.gamma, **options)
            with self.dev.stage("depth"):
                view = result.points, result.pairs, result.weights
                depths = depth_forward(self.dev, *view, self.model.grid.voxel_size)
            layers = [result.cropped(self.dev.download(array)) for array in depths]
            if features:
                layers.append(result.cropped(self.dev.download(result.features)))
            return RenderedView(self.shown(result, **options), *layers)

        rendered = mean_rendered_view(sample(dx, dy) for dy in shifts for dx in shifts)
        self.checked(rendered.colour)
        return rendered

    def shown(self, result: RenderResult, **options: Any) -> np.ndarray:
        """(height, width, 3) float32 in [0, 1]: the run's image of a view, given its renderer's
        result: the mean with the other members' images. options: of Renderer.forward(), for these.
        """
        images = [result.clamped()]
        for other in self.others:
            own = options | {"depth_range": other.depth_range(result.camera)}
            images.append(other.renderer.render(result.camera, other.gamma, **own))
        return images[0] if len(images) == 1 else np.mean(images, 0)

    @property
    def nearest(self) -> float:
        """Points nearer to the eye than this are not drawn; world units."""
        return NEAREST * self.ball[1]

    def checked(self, image: np.ndarray) -> np.ndarray:
        """The given image of the run. Raises UserError naming the checkpoint if it holds NaN."""
        if np.isnan(image).any():
            raise UserError(
                f"{self.folder.checkpoint}: its parameters are so large that the image holds NaN;"
                " restore a copy, or train again with a lower network.rate or train.sh_rate"
            )
        return image

    def depth_range(self, camera: Camera) -> tuple[float, float] | None:
        """(near, far) for any camera; None, which means the model's, if the blend depends on it."""
        if self.config.raster.blend == "softmax":
            return None
        centre, radius = self.ball
        distance = float(np.linalg.norm(camera.eye - centre))
        reach = radius + self.renderer.point_radius * math.exp(MOST_OFFSET)  # points are not cut
        return max(distance - reach, self.nearest), distance + radius


def scene_is_there(path: str) -> bool:
    """Whether a run's scene exists in a folder, or is the one that pp-cl makes."""
    return path == DEMO or Path(path).is_dir()


def check_scene(path: str) -> None:
    """Raise UserError if the folder of a run's scene is missing."""
    if not scene_is_there(path):
        raise UserError(f"{path}: the run's scene is missing; say where it is with --scene")


def stored_config(folder: RunFolder, scene: str | None = None) -> Config:
    """The settings of a run. scene: the folder of its scene, if it has moved. Raises UserError."""
    if scene is not None:
        check_scene(scene)
    config = load_config(folder.config)
    return configure(config, scene or config.scene.path)


def find_run(path: Path | str) -> RunFolder:
    """The run in a folder: the folder itself, or the run that `pp-cl make` has put into it, unless
    the folder is a scene.
    """
    folder, made = RunFolder(path), RunFolder(Path(path) / MADE)
    if folder.config.exists() or not made.config.exists():
        return folder
    try:
        scene_format(str(path))
    except UserError:
        return made
    return folder


def load(
    folder: Path | str, device: str | Device | None = None, *, scene: str | None = None
) -> Run:
    """The run in a folder, finished or not. device: an opened device, a choice as in open_device(),
    or None for the default. scene: the folder of its scene, if that has moved. Raises UserError
    naming a missing or broken file.
    """
    dev = device if isinstance(device, Device) else open_device(device)
    place = find_run(folder)
    config = stored_config(place, scene)
    header, arrays = load_run_state(place, config)
    net = UNet.of_settings(dev, config.network)
    model = load_model(dev, header, arrays, net, degree=config.points.sh_degree)
    others = []
    for number in range(2, config.train.members + 1):
        if (member := place.member(number)).checkpoint.exists():
            other = load(member.path, dev, scene=scene)
            others += [other] if other.header["finished"] else []
    return Run(dev, place, config, header, model, others)
