"""Makes a training's first network, and a sheet of the masks that contradict its hull."""

import warnings
from pathlib import Path

import numpy as np

from pp_cl.checkpoint import opened_run
from pp_cl.config import RANDOM, load_config, text_of
from pp_cl.engine.device.device import Device
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.views import View
from pp_cl.errors import UserError, few_names
from pp_cl.files.run_folder import MASKS_SHEET, RunFolder
from pp_cl.scene.hull import Agreement, Hull, contradicting
from pp_cl.scene.listing import DEMO
from pp_cl.scene.outline import outline_sheet
from pp_cl.settings import Config, NetworkConfig

# written by `make network`: {"net.NAME": as Network.parameters, float16}
DEMO_NETWORK = Path(__file__).with_name("demo.npz")


def begin_network(dev: Device, config: Config) -> UNet:
    """Make the network that network.start names; the demo's only for another scene and if it has
    this shape, else a random one. Raises UserError for a run whose network has another shape.
    """
    net = UNet.of_settings(dev, config.network, seed=config.train.seed)
    settings = config.network
    if settings.start == DEMO:
        if config.scene.path != DEMO and not _unlike(settings, NetworkConfig()):
            with np.load(DEMO_NETWORK) as stored:
                for name, parameter in net.parameters.items():
                    dev.write(parameter, stored[f"net.{name}"].astype(np.float32))
    elif settings.start != RANDOM:
        folder = RunFolder(settings.start)
        other = load_config(folder.config)
        for key, ours, theirs in _unlike(settings, other.network):
            raise UserError(
                f"network.start: {folder} has {key}={theirs}, this training {ours}; set {key}"
                " alike, or begin with another network"
            )
        with opened_run(folder, other) as run:
            for name, parameter in net.parameters.items():
                dev.write(parameter, run.array(f"net.{name}"))
    return net


def _unlike(ours, theirs):
    """[(key, our value, their value)] of the settings that make two networks differ in shape."""
    pairs = [(n, getattr(ours, n), getattr(theirs, n)) for n in ("widths", "blocks")]
    return [(f"network.{n}", text_of(a), text_of(b)) for n, a, b in pairs if a != b]


def sheet_of_masks(
    dev: Device, views: list[View], hull: Hull, agreement: Agreement
) -> np.ndarray | None:
    """Warn of masks that disagree with the others; return an image of them, None if all agree."""
    wrong, left_out = contradicting(views, hull, agreement), agreement.left_out
    rejecting = {
        disagreement.view.name: disagreement.share
        for disagreement in wrong
        if disagreement.view.name not in left_out
    }
    told = f"see {MASKS_SHEET} in the run's folder"
    if left_out:
        warnings.warn(
            "cameras or masks contradict the other views, left out of the training:"
            f" {few_names([*left_out])}; {told}",
            stacklevel=2,
        )
    if rejecting:
        worst = few_names([f"{name} ({share:.0%} of it)" for name, share in rejecting.items()])
        warnings.warn(f"masks reject what the other views agree on: {worst}; {told}", stacklevel=2)
    return outline_sheet(dev, views, hull, wrong) if wrong or left_out else None
