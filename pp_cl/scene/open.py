"""The scene that a run's settings name."""

import warnings
from pathlib import Path

import numpy as np

from pp_cl.config import Config
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.presets import IMAGE_SIZES
from pp_cl.scene import demo
from pp_cl.scene.load import Scene, find_reader, list_photographs, load_scene
from pp_cl.scene.masks import MaskRule
from pp_cl.scene.photograph import Photograph
from pp_cl.scene.views import MIN_SIDE, fitting_downscale

DEMO = "demo"  # the word that names the scene which the program makes itself


def open_scene(
    dev: Device, config: Config, splits: tuple[str, ...], most: int | None = None
) -> Scene:
    """Scene of config.scene.path with the given splits, reduced config.scene.downscale times;
    `demo` is rendered on the device. most: views of each split, spread evenly; None: all.
    """
    path, downscale = config.scene.path, config.scene.downscale
    if path == DEMO:
        return demo.demo_scene(dev, splits, most=most).reduced(downscale)
    scene = load_scene(path, splits, most, mask_rule(config), downscale=downscale)
    if most is None:
        _warn_without_masks(scene, config.scene.mask_from)
    return scene


def mask_rule(config: Config) -> MaskRule:
    """How the masks of the run's scene are made."""
    scene = config.scene
    return MaskRule(scene.mask_from, scene.masks, scene.mask_tolerance)


def _warn_without_masks(scene, source):
    """Say so where the points will fill a box, unless that was asked for."""
    views = scene.splits.get("train", [])
    if views and source != "box" and not any(view.has_mask for view in views):
        warnings.warn(
            f"{scene.folder}: no photograph has a mask: points fill the box that all cameras see;"
            " --mask-from color cuts out a uniform background, --masks FOLDER takes masks,"
            " --mask-from box says that it is meant",
            stacklevel=2,
        )


def scene_box(config: Config) -> np.ndarray | None:
    """(2, 3) lower and upper corner of the setting scene.box, None where there is none. Raises
    UserError for a box without volume.
    """
    corners = np.array(config.scene.box, np.float64).reshape(2, 3)
    if not corners.any():
        return None
    box = np.stack([corners.min(0), corners.max(0)])
    if not (box[1] > box[0]).all():
        raise UserError("scene.box: its corners must differ in x, y and z")
    return box


def scene_format(path: str) -> str:
    """The name of the reader of a scene; of `demo` the word itself. Raises UserError where there is
    no scene.
    """
    return DEMO if path == DEMO else find_reader(path).__name__.rpartition(".")[2]


def scene_splits(path: str) -> list[str]:
    """The names of a scene's splits. Raises UserError where there is no scene."""
    return list(demo.SPLITS) if path == DEMO else find_reader(path).splits(Path(path))


def scene_frames(path: str, split: str = "train") -> list[Photograph]:
    """The photographs of a split, without their pixels. Raises UserError as load_scene does."""
    if path == DEMO:
        return demo.demo_frames(split)
    return list_photographs(find_reader(path), Path(path), split)


def preset_downscale(path: str, preset: str) -> int:
    """How many times a preset reduces the images of a scene, by the size of the largest training
    image that leaves the smallest enough pixels. Raises UserError as load_scene does.
    """
    sizes = [(frame.camera.width, frame.camera.height) for frame in scene_frames(path)]
    largest, smallest = max(sizes, key=max), min(sizes, key=min)
    fitting = fitting_downscale(largest, IMAGE_SIZES[preset])
    return max(1, min(fitting, min(smallest) // MIN_SIDE))


def measured_split(path: str) -> str:
    """The split that tells how a training goes: val, else test. Raises UserError where the scene
    has neither.
    """
    present = scene_splits(path)
    for split in ("val", "test"):
        if split in present:
            return split
    raise UserError(f"--eval-every: {path} has no split val or test; leave it out")
