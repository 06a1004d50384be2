"""The scene that a run's settings name."""

import hashlib

import numpy as np

from pp_cl.config import Config
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.scene.load import Scene, load_scene
from pp_cl.scene.views import View


def open_scene(dev: Device, config: Config, splits: tuple[str, ...]) -> Scene:
    """Scene of config.scene.path with the given splits, reduced config.scene.downscale times;
    `demo` is rendered on the device.
    """
    if config.scene.path != "demo":
        return load_scene(config.scene.path, splits).reduced(config.scene.downscale)
    from pp_cl.scene.demo import SPLITS, demo_scene

    unknown = set(splits) - set(SPLITS)
    if unknown:
        raise UserError(f"--split {', '.join(unknown)}: demo has {', '.join(SPLITS)}")
    return demo_scene(dev, splits).reduced(config.scene.downscale)


def fingerprint(views: list[View]) -> str:
    """Hex digest of the views' names and stored cameras, by which a checkpoint knows its scene."""
    digest = hashlib.sha256()
    for view in views:
        camera = view.stored_camera
        digest.update(f"{view.name} {camera.width}x{camera.height} ".encode())
        digest.update(
            np.round(
                np.append(camera.pose.ravel(), [camera.fx, camera.fy, camera.cx, camera.cy]), 6
            ).tobytes()
        )
    return digest.hexdigest()
