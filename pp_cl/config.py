"""Settings: one dataclass a concern, their comments are the help text, their JSON is written beside the result."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from pp_cl.errors import UserError


@dataclass
class SceneConfig:
    """What is learned from."""

    path: str = ""  # folder of the scene, or the word demo
    downscale: int = 1  # train and evaluate on images this many times smaller


@dataclass
class PointsConfig:
    """The cloud of points."""

    count: int = 250_000  # wanted points on the grid inside the visual hull
    sh_degree: int = (
        2  # of the spherical harmonics that shade a point: 0 (the same from all sides), 1 or 2
    )
    footprint: str = "soft"  # soft: d = 1 - rho/R; disc: the paper's hard disc; sphere: Pulsar's rules for any radius
    radius: float = (
        0.75  # soft: in point spacings; disc and sphere: world units at a depth range of 4
    )
    gamma: tuple = (0.1, 0.01)  # depth sharpness of the blend, first and last step
    max_tracked: int = 0  # nearest hits of a pixel that get gradients, 0 = all (paper: 64)
    stop: float = (
        0.0  # stop a pixel where a hit could change it by less than this, 0 = never (paper: 0.001)
    )
    tau: float = 0.0  # drop a pixel's hits, from the back on, up to this sum of weights, 0 = none
    mean_gradient: bool = (
        False  # divide a point's gradients by its number of pixels, as Pulsar does
    )


@dataclass
class NetworkConfig:
    """The U-Net that turns features into colours."""

    widths: tuple = (32, 64, 128)  # channels of its three levels
    rate: tuple = (1e-3, 1e-4)  # Adam's rate, first and last step
    tolerance: float = (
        1e-5  # relative L2 error that the fastest way to compute a convolution may have
    )


@dataclass
class TrainConfig:
    """The course of the optimisation."""

    iterations: int = 8_000  # steps; every schedule ends here
    seed: int = 0  # of everything random
    crop: int = 128  # side of the square trained on in a step, 0 = whole images
    phases: bool = True  # draw the sub-pixel phase of the downscaled image anew in each step
    ssim_weight: float = 0.2  # loss = L1 + ssim_weight * (1 - SSIM)
    sh_rate: tuple = (
        0.5,
        0.25,
        0.125,
    )  # Adam's first rate of SH degrees 0, 1, 2; one of rate 0 stays 0 and is not updated
    sh_rate_decay: float = 0.1  # last over first rate
    sh_delay: tuple = (0.0, 0.01, 0.02)  # warm-up of each degree, as a share of the iterations
    feature_eps: float = 0.0197  # Adam's eps of SH, times the number of values the loss averages
    opacity_rate: tuple = (3e-2, 3e-3)  # Adam's rate, first and last step
    lazy: bool = False  # update only the points that received a gradient; false: momentum moves the others too
    half_moments: bool = False  # keep Adam's moments of the SH coefficients in 16 bits
    dropout: float = 0.15  # share of the points left out at random in a step
    smooth: float = (
        0.03  # pull towards the mean of the grid neighbours, in units of the SH rate, 0 = off
    )
    smooth_every: int = 4  # steps between two such pulls
    prune_weight: float = 1e-3  # drop points whose mean blend weight a step is lower, 0 = off
    prune_opacity: float = 0.01  # drop points less opaque than this
    prune_every: int = 250  # steps between two prunings
    final_weight: float = (
        1.0  # at the end drop points whose summed weight over the training views is lower
    )
    average: bool = True  # keep averaged (EMA) weights over the last 30 % and deliver these
    checkpoint_every: int = 1000  # steps
    memory: float = 0.0  # GiB of device memory to take; what is not needed keeps the hits of views that stay, 0 = none kept
    log_every: int = 50  # steps
    previews: int = 4  # pictures over the whole run

    def crop_size(self, width, height):
        """(width, height) of what a step trains on, of a picture of width x height."""
        return (min(self.crop, width), min(self.crop, height)) if self.crop else (width, height)


@dataclass
class Config:
    """All settings of a run."""

    preset: str = "tiny"
    scene: SceneConfig = field(default_factory=SceneConfig)
    points: PointsConfig = field(default_factory=PointsConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def to_json(self):
        """The settings as JSON text."""
        return json.dumps(dataclasses.asdict(self), indent=1)


# What differs from the defaults above, which are the tiny preset: minutes on a CPU.
PRESETS = {
    "tiny": {},
    # for 400 x 400; 8000 steps take a quarter of an hour on a CPU, the whole schedule has not been timed
    "small": {"points.count": 1_000_000, "train.iterations": 20_000, "train.crop": 192},
    # the supplemental's own numbers; what it does not state is as above
    "paper": {
        "points.count": 4_000_000,
        "points.footprint": "disc",
        "points.radius": 0.0015,
        "points.max_tracked": 64,
        "points.stop": 0.001,
        "network.widths": (128, 256, 512),
        "network.rate": (3e-4, 5e-5),
        "train.iterations": 50_000,
        "train.crop": 0,
        "train.phases": False,
        "train.dropout": 0.0,
        "train.smooth": 0.0,
        "train.average": False,
        "train.prune_weight": 1e-4,
        "train.prune_every": 500,
        "train.checkpoint_every": 5000,
    },
}


def preset(name):
    """Config of a preset. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"--preset {name}: unknown; choose from {', '.join(PRESETS)}")
    config = Config(preset=name)
    for key, value in PRESETS[name].items():
        assign(config, key, value, "preset")
    return config


def assign(config, key, value, origin):
    """Set section.key from a value or its text. Raises UserError naming the origin and the key."""
    section, _, name = key.partition(".")
    owner = getattr(config, section, None)
    if not dataclasses.is_dataclass(owner):
        raise UserError(f"{origin}: unknown key {key!r}; keys look like train.iterations")
    known = {f.name for f in dataclasses.fields(owner)}
    if name not in known:
        raise UserError(f"{origin}: unknown key {key!r}; {section} has {', '.join(sorted(known))}")
    setattr(owner, name, _convert(value, getattr(owner, name), f"{origin}: {key}"))


def _convert(value, example, where):
    """The value, or its text, as the type of the example. Raises UserError."""
    if isinstance(example, tuple):
        items = (
            value.split(",")
            if isinstance(value, str)
            else list(value)
            if isinstance(value, (list, tuple))
            else [value]
        )
        if len(items) != len(example):
            raise UserError(
                f"{where}: {value!r} is not {len(example)} values separated by commas, like {','.join(map(str, example))}"
            )
        return tuple(_convert(v, e, where) for v, e in zip(items, example, strict=True))
    kind, convert = KINDS[type(example)]
    try:
        return convert(value)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise UserError(f"{where}: {value!r} is not {kind}") from None


def _whole(value):
    number = float(value)
    if number != int(number):
        raise ValueError
    return int(number)


def _finite(value):
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


# type of a setting: (what it is called, conversion of a value or its text)
KINDS = {
    int: ("a whole number", _whole),
    float: ("a finite number", _finite),
    str: ("a word", str),
    bool: (
        "true or false",
        lambda value: {"true": True, "1": True, "false": False, "0": False}[str(value).lower()],
    ),
}

# section.key: (least, largest) allowed
LIMITS = {
    "scene.downscale": (1, 64),
    "points.count": (1, 2**27),
    "points.sh_degree": (0, 2),
    "points.radius": (1e-6, 100),
    "points.max_tracked": (0, 2**31 - 1),
    "points.stop": (0, 0.5),
    "points.tau": (0, 0.5),
    "network.tolerance": (0, 1),
    "train.iterations": (1, 10**8),
    "train.seed": (0, 2**32 - 1),
    "train.crop": (0, 2**14),
    "train.ssim_weight": (0, 10),
    "train.dropout": (0, 0.95),
    "train.smooth": (0, 0.25),
    "train.smooth_every": (1, 10**8),
    "train.prune_weight": (0, 1e6),
    "train.prune_opacity": (0, 1),
    "train.prune_every": (1, 10**8),
    "train.checkpoint_every": (1, 10**8),
    "train.memory": (0, 2**20),
    "train.log_every": (1, 10**8),
    "train.previews": (0, 1000),
    "train.sh_rate_decay": (1e-6, 1),
    "train.feature_eps": (1e-30, 1e3),
    "train.final_weight": (0, 1e9),
}


def validate(config, origin):
    """Raise UserError naming the first key whose value makes no sense."""
    for key, (least, largest) in LIMITS.items():
        section, name = key.split(".")
        value = getattr(getattr(config, section), name)
        if not least <= value <= largest:
            raise UserError(f"{origin}: {key} = {value}; it must lie in [{least}, {largest}]")
    if config.points.footprint not in ("soft", "disc", "sphere"):
        raise UserError(
            f"{origin}: points.footprint = {config.points.footprint!r}; choose soft, disc or sphere"
        )
    if config.train.crop % 4:
        raise UserError(
            f"{origin}: train.crop = {config.train.crop}; it must be a multiple of 4 (0 = whole images)"
        )
    if not all(1e-5 <= g <= 1 for g in config.points.gamma):
        raise UserError(
            f"{origin}: points.gamma = {config.points.gamma}; both must lie in [1e-5, 1]"
        )
    if not all(1 <= w <= 4096 for w in config.network.widths):
        raise UserError(
            f"{origin}: network.widths = {config.network.widths}; each must lie in [1, 4096]"
        )
    rates = config.network.rate + config.train.opacity_rate
    if not all(0 < r <= 100 for r in rates) or not all(0 <= r <= 100 for r in config.train.sh_rate):
        raise UserError(f"{origin}: rates must lie in (0, 100], sh_rate in [0, 100]")
    if not all(0 <= d <= 1 for d in config.train.sh_delay):
        raise UserError(f"{origin}: sh_delay must lie in [0, 1]")


def load_config(path):
    """Config of a config.json. Raises UserError naming the file and the key."""
    path = Path(path)
    try:
        stored = json.loads(path.read_text())
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; is this the folder of a run?") from None
    except ValueError as error:
        raise UserError(f"{path}: not JSON ({error}); restore it or start a new run") from None
    if not isinstance(stored, dict) or not isinstance(stored.get("preset"), str):
        raise UserError(f"{path}: key preset is missing; restore it or start a new run")
    config = Config(preset=stored.pop("preset"))
    for section, values in stored.items():
        if not isinstance(values, dict):
            raise UserError(f"{path}: {section} is not an object")
        for name, value in values.items():
            assign(config, f"{section}.{name}", value, str(path))
    validate(config, str(path))
    return config


def help_lines():
    """Lines `section.key = default  # comment` of all settings, read from this file: the text of `--help`."""
    lines, section = [], None
    names = {
        "SceneConfig": "scene",
        "PointsConfig": "points",
        "NetworkConfig": "network",
        "TrainConfig": "train",
    }
    for line in Path(__file__).read_text().splitlines():
        if line.startswith("class "):
            section = names.get(line[6:].rstrip(":"))
        elif section and line.startswith("    ") and ":" in line and "  # " in line:
            code, _, comment = line.partition("  # ")
            name, _, rest = code.strip().partition(":")
            lines.append(f"  {section}.{name} = {rest.partition('=')[2].strip()}  ({comment})")
    return lines
