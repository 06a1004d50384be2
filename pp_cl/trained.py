"""What a training leaves: a model that can be rendered from anywhere."""

import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.config import Config, configure, load_config
from pp_cl.device.device import Device
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.picture import Picture, mean_picture
from pp_cl.files.run_folder import RunFolder
from pp_cl.layers.choice import ConvolutionPolicy, load_policy
from pp_cl.model import Model
from pp_cl.network.unet import UNet
from pp_cl.render import Renderer
from pp_cl.scene.camera import Camera
from pp_cl.scene.identity import difference, kept_views
from pp_cl.scene.load import Scene
from pp_cl.scene.open import DEMO, open_scene, scene_frames
from pp_cl.scene.photograph import Photograph
from pp_cl.training.schedule import gamma_at
from pp_cl.training.stored import load_run_state

COMPARED_VIEWS = 2  # training photographs that tell whether a scene is the run's
NEAREST = 0.05  # of a point to the eye, in radii of the object


@dataclass
class Run:
    """The model of a run's last checkpoint. header: of the checkpoint, see files/run_folder.py.
    policy: of the convolutions.
    """

    dev: Device
    folder: RunFolder
    config: Config
    header: dict[str, Any]
    model: Model
    policy: ConvolutionPolicy

    @cached_property
    def renderer(self) -> Renderer:
        """Renders the model, whose parameters must not change any more."""
        self.model.net.freeze()
        return Renderer(self.dev, self.model, self.config.raster)

    @property
    def gamma(self) -> float:
        """Depth sharpness of the blend at the run's last step."""
        return gamma_at(
            self.header["step"], self.config.train.iterations, *self.config.raster.gamma
        )

    def scene(self, split: str) -> Scene:
        """The run's scene with one split. Raises UserError where it is missing, broken or another
        one than the run has learned.
        """
        self.check_scene()
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
            listed, views = scene_frames(path), read()
        except UserError as error:
            warnings.warn(
                f"{path}: cannot be compared with the scene of {self.folder} ({error})",
                stacklevel=3,
            )
            return
        if told := difference(header, listed, views):
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
        self.check_scene()
        listed = scene_frames(self.config.scene.path, split)
        self._compare(list)
        return listed

    def cameras(self, split: str = "test") -> list[Camera]:
        """The cameras of a split's views at the resolution of the run. Raises UserError as
        photographs() does.
        """
        downscale = self.config.scene.downscale
        return [one.camera.downscaled(downscale) for one in self.photographs(split)]

    def check_scene(self) -> None:
        """Raise UserError where the run's scene is not where its settings say."""
        check_scene(self.config.scene.path)

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
        """The model as the camera sees it.

        samples: a square number of images, shifted by fractions of a pixel, whose mean it is.
        features: with the network's input. Raises ValueError for another number of samples,
        UserError as checked() does.
        """
        side = math.isqrt(samples)
        if samples < 1 or side * side != samples:
            raise ValueError(f"{samples} samples are no square number")
        shifts = (np.arange(side) + 0.5) / side - 0.5
        options = {"features": features, "depth_range": self.depth_range(camera)}
        pictures = [
            self.renderer.picture(camera.shifted(dx, dy), self.gamma, **options)
            for dy in shifts
            for dx in shifts
        ]
        picture = mean_picture(pictures)
        self.checked(picture.colour)
        return picture

    def checked(self, image: np.ndarray) -> np.ndarray:
        """An image of the run. Raises UserError naming the checkpoint where it holds NaN: finite
        parameters may be too large to compute with.
        """
        if np.isnan(image).any():
            raise UserError(
                f"{self.folder.checkpoint}: its parameters are too large, the image holds NaN;"
                " restore a copy, or train anew with a lower network.rate or train.sh_rate"
            )
        return image

    def depth_range(self, camera: Camera) -> tuple[float, float] | None:
        """(near, far) of a camera anywhere; None, the model's, where the blend depends on it."""
        if self.config.raster.blend == "softmax":
            return None
        centre, radius = self.ball
        distance = float(np.linalg.norm(camera.eye - centre))
        return max(distance - radius, NEAREST * radius), distance + radius


def check_scene(path: str) -> None:
    """Raise UserError where the folder of a run's scene is not there."""
    if path != DEMO and not Path(path).is_dir():
        raise UserError(f"{path}: the run's scene is not there; say where with --scene")


def load_run(
    dev: Device,
    folder: Path | str,
    *,
    tolerance: float | None = None,
    scene: str | None = None,
) -> Run:
    """The run in a folder, finished or not.

    tolerance: in place of its network.tolerance; scene: the folder of its scene, if that has moved.
    Raises UserError naming the file that is missing or broken.
    """
    if scene is not None:
        check_scene(scene)
    folder = RunFolder(folder)
    config = load_config(folder.config)
    given = [] if tolerance is None else [("network.tolerance", tolerance, "tolerance")]
    configure(config, scene or config.scene.path, given)
    header, arrays = load_run_state(folder, config)
    policy = load_policy(dev, config.network.tolerance)
    net = UNet.of_settings(dev, config.network, policy)
    model = Model.load(dev, header, arrays, net, degree=config.points.sh_degree)
    return Run(dev, folder, config, header, model, policy)


def load(folder: Path | str, device: str | None = None) -> Run:
    """The run in a folder, on a device: as `pp-cl devices` lists them, else the default one. Raises
    UserError naming the file that is missing or broken.
    """
    return load_run(open_device(device), folder)
