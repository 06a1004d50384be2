"""The presets, and the names by which settings are or were known: data only."""

# What differs from the defaults in config.py, which are the tiny preset: minutes on a CPU.
PRESETS = {
    "tiny": {},
    # for 400 x 400: begins at half the size; 20 minutes on a CPU
    "small": {
        "points.count": 170_000,
        "train.iterations": 6_000,
        "train.refine_at": (0.35, 1.0),
        "train.crop": 160,
    },
    # for 800 x 800: begins at a quarter of the size, where fog clears at little cost
    "full": {
        "points.count": 170_000,
        "raster.radius": 0.75,  # 1 takes longer here, for 0.2 dB less
        "train.iterations": 11_000,
        "train.refine_at": (0.33, 0.67),
        "train.crop": 256,
    },
    "paper": {
        # Stated by the supplemental, as are the defaults of raster.gamma, train.sh_rate and its
        # decay, and the delays of 0, 500 and 1000 steps.
        "points.count": 4_000_000,
        "points.opacity": 1.0,
        "raster.blend": "softmax",
        "raster.footprint": "disc",
        "raster.radius": 0.0015,
        "raster.max_tracked": 64,
        "network.widths": (128, 256, 512),
        "network.blocks": "double",
        "network.residual": False,
        # Inferred from INPC, a later method of the same first author: the supplemental gives no
        # number.
        "network.rate": (3e-4, 5e-5),
        "train.iterations": 50_000,
        "train.crop": 0,
        # Ours: the supplemental mentions no jitter, dropout, smoothing or averaging, and no rule
        # of pruning. Ours in all presets: the loss and its weight, Adam's eps, the opacity's rate.
        "train.smooth_l1": 0.0,
        "train.sh_eps": 0.0197,
        "train.opacity_rate": (3e-2, 3e-3),
        "train.opacity_rate_steps": 0,
        "train.pixel_jitter": False,
        "train.dropout": 0.0,
        "train.sh_smoothing": 0.0,
        "train.ema": False,
        "train.mask_weight": 0.0,
        "train.spread_weight": 0.0,
        "train.prune_every": 500,
        "train.checkpoint_every": 5000,
    },
}

# Pixels of the longer side of the images that a preset is made for: it reduces larger ones. None:
# as they are.
IMAGE_SIZES = {"tiny": 200, "small": 400, "full": None, "paper": None}

# Settings with a short name on the command line and in run.train_scene().
SHORT = {
    "iterations": "train.iterations",
    "points": "points.count",
    "downscale": "scene.downscale",
    "masks": "scene.masks",
    "mask_from": "scene.mask_from",
    "eval_every": "train.eval_every",
    "seed": "train.seed",
    "memory": "train.memory_gib",
    "tolerance": "network.tolerance",
}

# Old key: new key. Old keys are accepted in this version and noted in config.Config.notes.
RENAMED = {
    "points.footprint": "raster.footprint",
    "points.radius": "raster.radius",
    "points.gamma": "raster.gamma",
    "points.max_tracked": "raster.max_tracked",
    "points.stop": "raster.early_stop",
    "points.tau": "raster.tau",
    "points.mean_gradient": "raster.mean_gradient",
    "train.phases": "train.pixel_jitter",
    "train.feature_eps": "train.sh_eps",
    "train.smooth": "train.sh_smoothing",
    "train.smooth_every": "train.sh_smoothing_every",
    "train.final_weight": "train.final_prune_weight",
    "train.average": "train.ema",
    "train.memory": "train.memory_gib",
}


# What a setting is taken for that a config.json of an earlier format may lack, since it came later:
# what the program did before.
ABSENT = {
    "scene.mask_from": "given",
    "scene.masks": "",
    "scene.mask_tolerance": 10.0,
    "scene.box": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "points.opacity": 1.0,
    "points.sh_degree": 2,
    "raster.blend": "softmax",
    "raster.tau": 0.0,
    "raster.window": "image",
    "network.blocks": "double",
    "network.channels": "",
    "network.residual": False,
    "network.tolerance": 1e-5,
    "train.opacity_rate_steps": 0,
    "train.smooth_l1": 0.0,
    "train.mask_weight": 0.0,
    "train.spread_weight": 0.0,
    "train.perceptual_weight": 0.0,
    "train.prune_looks": 100,
    "train.refine_at": (1.0, 1.0),
    "train.memory_gib": 0.0,
    "train.eval_every": 0,
    "train.checkpoint_minutes": 0.0,
}

# Settings of formats before 3, for the moments of the SH coefficients that Adam kept then, by their
# names and older ones: a finished run is what it is without them.
REMOVED = ("train.lazy_adam", "train.lazy", "train.moments_16bit", "train.half_moments")

# The format of config.json that first had a key of ABSENT; the others came with format 1.
ADDED = {
    "train.checkpoint_minutes": 2,
    "network.channels": 2,
    "network.residual": 3,
    "train.smooth_l1": 3,
    "train.spread_weight": 4,
}
