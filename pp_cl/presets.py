"""The presets tiny, small, full, best and paper, and the short names of settings: data only."""

from typing import Any

# Settings that differ from the defaults in settings.py. These are tiny: minutes on a CPU.
PRESETS: dict[str, dict[str, Any]] = {
    "tiny": {},
    # for images of 400 x 400: training begins at half the size
    "small": {
        "points.count": 170_000,
        "train.iterations": 6_000,
        "train.crop": 160,
    },
    # for images of 800 x 800: training begins at a quarter of the size, to clear fog cheaply
    "full": {
        "points.count": 170_000,
        "raster.radius": 0.75,  # 1 takes longer here, for 0.2 dB less
        "train.iterations": 22_000,
        "train.crop": 256,
    },
    "paper": {
        # The supplemental states these, the default of train.sh_rate, and values that all presets
        # share: gamma, the decay of the SH's rates and their delays of 0, 500 and 1000 steps
        # (training/schedule.py).
        "points.count": 4_000_000,
        "points.opacity": 1.0,
        "raster.blend": "softmax",
        "raster.footprint": "disc",
        "raster.radius": 0.0015,
        "raster.early_stop": 0.001,
        "raster.max_tracked": 64,
        "network.widths": (128, 256, 512),
        "network.blocks": "double",
        "network.residual": False,
        # Inferred from INPC, a later method of the same first author: the supplemental gives no
        # number.
        "network.rate": (3e-4, 5e-5),
        "train.iterations": 50_000,
        "train.crop": 0,
        # Our choice: the supplemental mentions no supersampling, jitter, smoothing or averaging and
        # no rule of pruning. Ours in all presets: the loss, its weight, Adam's eps, opacity's rate.
        "train.smooth_l1": 0.0,
        "train.sh_eps": 0.0197,
        "train.opacity_rate": (3e-2, 3e-3),
        "train.view_opacity": "off",
        "train.rate_steps": 0,
        "train.offset_rate": (0.0, 0.0),
        "train.supersampled": 0.0,
        "train.pixel_jitter": False,
        "train.sh_smoothing": 0.0,
        "train.ema": False,
        "train.specular": "off",
        "train.mask_weight": 0.0,
        "train.distortion_weight": 0.0,
        "train.prune_every": 500,
        "train.refine_at": (1.0, 1.0),
        "train.checkpoint_every": 5000,
    },
}

# trains full twice and shows the mean of both images
PRESETS["best"] = PRESETS["full"] | {"train.members": 2}

# A training with fewer steps than its preset has here warns that they are few. With this many, lego
# reaches about 31 dB.
FEW = {"tiny": 300, "small": 1_000, "full": 1_500, "best": 1_500, "paper": 10_000}

# A preset reduces larger images to this many pixels on the longer side. full is made for 800, but
# images of 1600 gain by it, too; with 4000, memory limits points to ten pixels apart. None: as is.
IMAGE_SIZES = {"tiny": 200, "small": 400, "full": 1600, "best": 1600, "paper": None}

# Settings with a short name on the command line and in session.train_scene().
SHORT = {
    "iterations": "train.iterations",
    "minutes": "train.minutes",
    "points": "points.count",
    "downscale": "scene.downscale",
    "masks": "scene.masks",
    "ignore": "scene.ignore",
    "mask_from": "scene.mask_from",
    "eval_every": "train.eval_every",
    "seed": "train.seed",
    "memory": "train.memory_gib",
    "network": "network.start",
}
