"""Every setting with its default, help text and limits: one dataclass for each section."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

FORMAT = 3  # of config.json: goes up when keys change meaning or go; added ones: config.ADDED
BLOCKS = ("double", "single", "gated")  # kinds of blocks at a level of the network


def setting(
    default: Any,
    help: str,
    least: float | None = None,
    most: float | None = None,
    *,
    choices: tuple[str, ...] = (),
) -> Any:
    """A dataclass field with its line of --help and the values allowed: [least, most], for a tuple
    of each element, or one of `choices`.
    """
    metadata = {"help": help, "least": least, "most": most, "choices": choices}
    return field(default=default, metadata=metadata)


@dataclass
class SceneConfig:
    """The photographs."""

    path: str = setting("", "folder of the scene, or the word demo")
    downscale: float = setting(
        1.0, "reduce the images this many times (if not given: to about the preset's size)", 1, 64
    )
    mask_from: str = setting(
        "given",
        "given: the masks of the scene's format, else alpha; alpha: of the images; color: cut"
        " out a uniform background; box, none: no masks, points fill a box",
        choices=("given", "alpha", "color", "box", "none"),
    )
    masks: str = setting("", "masks named like the photographs, white on the object")
    ignore: str = setting("", "masks that are white where photographs say nothing")
    mask_tolerance: float = setting(
        10.0, "largest CIELAB distance from the background's colour that is background", 0.1, 100
    )
    box: tuple = setting(
        (0.0,) * 6, "two corners x, y, z of a box that the points fill (zeros: none)", -1e30, 1e30
    )


@dataclass
class PointsConfig:
    """The point cloud."""

    count: int = setting(250_000, "points wanted in the visual hull", 1, 2**27)
    opacity: float = setting(0.1, "opacity of all points before training", 0, 1)
    sh_degree: int = setting(
        2, "degree of the spherical harmonics (SH): 0 (the same from all sides), 1 or 2", 0, 2
    )


@dataclass
class RasterConfig:
    """From points to a feature image."""

    footprint: str = setting(
        "soft",
        "soft: opacity falls linearly to the rim; disc: the paper's hard disc",
        choices=("soft", "disc"),
    )
    radius: float = setting(
        0.0,
        "before points learn their own (train.offset_rate). soft: in point spacings (0: one pixel"
        " of the images); disc: in world units at a depth range of 4",
        0,
        100,
    )
    blend: str = setting(
        "alpha",
        "alpha: compositing from front to back; softmax: the paper's Eq. (1)",
        choices=("softmax", "alpha"),
    )
    max_tracked: int = setting(
        0,
        "softmax: number of a pixel's nearest fragments that receive gradients (0: all)",
        0,
        2**31 - 1,
    )
    early_stop: float = setting(
        0.01, "stop blending once no fragment can weigh more than this share (0: never)", 0, 0.5
    )


@dataclass
class NetworkConfig:
    """The U-Net that turns features into colours."""

    widths: tuple = setting((32, 64, 128), "channels of its three levels", 1, 4096)
    blocks: str = setting(
        "single",
        "of a level. double: two 3x3 convolutions with ReLU; single: one; gated: ELU of one"
        " times the sigmoid of another",
        choices=BLOCKS,
    )
    residual: bool = setting(True, "add a quarter of the first three features to the colours")
    start: str = setting(
        "demo",
        "what the network begins with. demo: weights that were trained on the demo, if the scene is"
        " another and the network has the default shape; random: random numbers; a folder: the"
        " weights of that run",
    )
    rate: tuple = setting(
        (1e-3, 1e-4), "learning rate of the network, first and last step", 1e-12, 100
    )


@dataclass
class TrainConfig:
    """The optimisation."""

    iterations: int = setting(
        8_000, "training steps, where every schedule ends; more extend a finished run", 1, 10**8
    )
    minutes: float = setting(
        0.0,
        "minutes of the training with all that comes before and after its steps; schedules follow"
        " the time that has passed (0: as many steps as set)",
        0,
        1440,
    )
    seed: int = setting(0, "seed of all random choices", 0, 2**32 - 1)
    crop: int = setting(
        128, "side in pixels of the square crop of a step (0: whole images)", 0, 2**14
    )
    supersampled: float = setting(
        0.25,
        "share of the steps, the last ones, in which a pixel's features are means of 2 x 2 samples;"
        " they take 1.3 times as long, as do renderings from then on (blend alpha, soft and disc)",
        0,
        1,
    )
    pixel_jitter: bool = setting(
        True,
        "shift the image by a random part of a pixel each step: where it is reduced, by whole"
        " stored pixels; else by up to an eighth of a pixel",
    )
    ssim_weight: float = setting(0.2, "loss = smooth L1 + ssim_weight * (1 - SSIM)", 0, 10)
    smooth_l1: float = setting(0.05, "errors below this count by their square (0: L1)", 0, 1)
    exposure: str = setting(
        "auto",
        "exposure compensation: a gain for each view and channel, or a 3x4 colour matrix for each"
        " view; auto: where they explain a quarter of the error",
        choices=("auto", "on", "off"),
    )
    mask_weight: float = setting(
        0.5,
        "mask term of the loss: mean square of rendered alpha minus mask; where alpha is too"
        " low its weight rises from 0 during training; needs raster.blend=alpha and masks (0:"
        " off)",
        0,
        1e3,
    )
    distortion_weight: float = setting(
        0.6,
        "weight of the distortion loss: how far a pixel's blend weights lie apart along its ray, as"
        " a share of the grid's diagonal; rises from 0 during training; needs raster.blend=alpha"
        " (0: off)",
        0,
        1e3,
    )
    depth_weight: float = setting(
        0.0,
        "weight of the depth loss: how much surfaces bend between pixels, in point spacings; in the"
        " last quarter of the steps; needs raster.blend=alpha (0: off; make takes 0.001 for"
        " photographs)",
        0,
        1e3,
    )
    sh_rate: tuple = setting(
        (0.5, 0.25, 0.125), "first learning rate of SH degrees 0, 1, 2, ten times the last", 0, 100
    )
    sh_eps: float = setting(
        0.01, "eps of the SH step, times 3*H*W of the training image", 1e-30, 1e3
    )
    opacity_rate: tuple = setting(
        (3e-2, 1e-2), "learning rate of the opacities, first and last step", 1e-12, 100
    )
    view_opacity: str = setting(
        "auto",
        "opacity that depends on the direction, by harmonics of degrees 1 and 2; auto: unless"
        " masks contradict each other, as it would fit each view's wrong one",
        choices=("auto", "on", "off"),
    )
    offset_rate: tuple = setting(
        (1e-2, 1e-3),
        "learning rate of the points' offsets in voxels, and of the logarithm of their radii,"
        " first and last step; needs raster.blend=alpha and raster.footprint=soft (0: points stay"
        " on the grid, with one radius)",
        0,
        1,
    )
    rate_steps: int = setting(
        1000,
        "steps that opacity_rate, and sh_rate above degree 0, are meant for: longer trainings"
        " multiply them by the square root of this over their iterations (0: never)",
        0,
        10**8,
    )
    sh_smoothing: float = setting(
        0.03, "each step's pull of the SH to neighbours, times their rate (0: off)", 0, 0.25
    )
    prune_weight: float = setting(
        0.05,
        "prune points whose blend weight, summed over a step's pixels, has not reached this in any"
        " step, or whose opacity is below 0.01; after the last step, those that reach it in no"
        " training view, of 24 and more in at most one (0: off)",
        0,
        1e6,
    )
    prune_every: int = setting(250, "steps between two prunings", 1, 10**8)
    refine_at: tuple = setting(
        (0.0, 0.0),
        "shares of the iterations after which images double in size and a point becomes eight;"
        " training begins on images that much smaller (1: never; 0,0: until points are at most 1.5"
        " pixels apart)",
        0,
        1,
    )
    specular: str = setting(
        "auto",
        "specular layer, fitted after the last step: colours of a pixel by its features, its"
        " direction and its place; auto: as far as it explains views that it was not fitted to;"
        " needs raster.blend=alpha",
        choices=("auto", "off"),
    )
    members: int = setting(
        1,
        "trainings, with the next seeds, of whose images the mean is shown; each takes as long as"
        " one, or its share of the minutes",
        1,
        8,
    )
    ema: bool = setting(
        True, "average the parameters (EMA) over the last 15 % of the steps and keep the averages"
    )
    checkpoint_every: int = setting(1000, "steps between two checkpoints", 1, 10**8)
    checkpoint_minutes: float = setting(
        10.0, "minutes after which the next step writes a checkpoint (0: never)", 0, 10**6
    )
    memory_gib: float = setting(0.0, "device memory for training, in GiB (0: all)", 0, 2**20)
    log_every: int = setting(50, "steps between two rows of log.jsonl", 1, 10**8)
    eval_every: int = setting(
        0, "steps between measurements of a few val, else test views (0: none)", 0, 10**8
    )


@dataclass
class Config:
    """All settings of a run. decisions: {section.key: reason} of what the training decided."""

    preset: str = "tiny"
    decisions: dict[str, str] = field(default_factory=dict)
    scene: SceneConfig = field(default_factory=SceneConfig)
    points: PointsConfig = field(default_factory=PointsConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def to_json(self) -> str:
        """The settings as JSON text: {"format": FORMAT, "preset": name, "decisions":
        {key: reason}, section: {name: value}}.
        """
        return json.dumps({"format": FORMAT, **dataclasses.asdict(self)}, indent=1)


def every_setting(config: Config) -> Iterator[tuple[str, Any, dataclasses.Field]]:
    """(section.key, the section that holds its value, its field) of each setting, in their order:
    the value is getattr(section, field.name).
    """
    for name, section in vars(config).items():
        if dataclasses.is_dataclass(section):
            for item in dataclasses.fields(section):
                yield f"{name}.{item.name}", section, item
