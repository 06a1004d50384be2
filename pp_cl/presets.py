"""The presets tiny, small, full, best and paper, and the short names of settings: data only."""

from typing import Any

# What differs from the defaults in settings.py, which are the tiny preset: minutes on a CPU.
PRESETS: dict[str, dict[str, Any]] = {
    "tiny": {},
    # for 400 x 400: begins at half the size; 20 minutes on a CPU
    "small": {
        "points.count": 170_000,
        "train.iterations": 6_000,
        "train.crop": 160,
    },
    # for 800 x 800: begins at a quarter of the size, where fog clears at little cost
    "full": {
        "points.count": 170_000,
        "raster.radius": 0.75,  # 1 takes longer here, for 0.2 dB less
        "train.iterations": 15_000,
        "train.crop": 256,
    },
    "paper": {
        # Stated by the supplemental, as are the default of train.sh_rate, and what is the same in
        # all presets: gamma, the decay of the SH's rates and their delays of 0, 500 and 1000 steps
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
        # Ours: the supplemental mentions no supersampling, jitter, smoothing or averaging, no rule
        # of pruning. Ours in all presets: the loss and its weight, Adam's eps, the opacity's rate.
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

# two of full, whose images' mean is shown
PRESETS["best"] = PRESETS["full"] | {"train.members": 2}

# Steps below which a training of a preset says that they are few: with as many, lego has about
# 31 dB.
FEW = {"tiny": 300, "small": 1_000, "full": 1_500, "best": 1_500, "paper": 10_000}

# Pixels of the longer side that a preset reduces larger images to. full is made for 800, but those
# of 1600 gain by it, too; with 4000 memory leaves points ten pixels apart. None: as they are.
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
