"""What a training is asked to be, against what its folder says it is."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from pp_cl.config import Config, assign, configure, load_config, preset, sections
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.open import preset_downscale
from pp_cl.training.stored import load_run_state, opened_run

Stored = tuple[dict[str, Any], dict[str, np.ndarray]]  # header and arrays of a checkpoint


def run_config(
    folder: RunFolder,
    scene: str,
    preset_name: str | None = None,
    given: Iterable[tuple[str, Any, str]] = (),
    *,
    extends: bool = False,
) -> Config:
    """Config of a training in `folder`: its stored one if it has one, else the preset's, with the
    given settings. Where these do not say scene.downscale, a new one reduces the images to about
    the preset's size.

    scene: a folder, or the word demo. given: (key, value or its text, origin), which a run with a
    checkpoint must agree with; without one there is nothing that other settings would spoil.
    extends: a finished run may have train.iterations given anew: with more of them it goes on, with
    fewer it stays finished. Raises UserError naming the first setting that differs or makes no
    sense, or what is wrong with the scene's files.
    """
    stored = load_config(folder.config) if folder.config.exists() else None
    if stored and preset_name not in (None, stored.preset):
        if folder.checkpoint.exists():
            raise UserError(
                f"{folder.config}: preset is {stored.preset} there, {preset_name} asked for; use"
                " another --out"
            )
        stored = None
    config = load_config(folder.config) if stored else preset(preset_name or "tiny")
    given = list(given)
    configure(config, scene, given)
    if not stored and "scene.downscale" not in [key for key, _, _ in given]:
        downscale = preset_downscale(config.scene.path, config.preset)
        assign(config, "scene.downscale", downscale, "preset")
    if stored and folder.checkpoint.exists():
        if extends and config.train.iterations != stored.train.iterations:
            with opened_run(folder, stored) as run:
                if run.header["step"] == stored.train.iterations:
                    most = max(config.train.iterations, stored.train.iterations)
                    for one in (config, stored):
                        assign(one, "train.iterations", most, "settings")
        _check_same(config, stored, folder)
    return config


def _check_same(asked, stored, folder):
    """Raise UserError naming the first setting that differs, the place of the scene aside: a
    checkpoint knows its scene by more than that.
    """
    for (section, ours), (_, theirs) in zip(sections(asked), sections(stored), strict=True):
        for name, value in vars(ours).items():
            there = getattr(theirs, name)
            if value != there and (section, name) != ("scene", "path"):
                _refuse_setting(folder, f"{section}.{name}", there, value)


def _refuse_setting(folder, key, there, asked):
    raise UserError(
        f"{folder.config}: {key} is {there} there, {asked} asked for; use another --out, or the"
        " settings of the run"
    )


def stored_state(folder: RunFolder, config: Config) -> Stored | None:
    """(header, arrays) of the folder's checkpoint, None where there is none. Raises UserError for a
    folder or checkpoint that does not fit.
    """
    folder.check_usable()
    stored = load_run_state(folder, config) if folder.checkpoint.exists() else None
    if folder.config.exists() and (stored is None or is_finished(stored, config)):
        path = load_config(folder.config).scene.path
        if path != config.scene.path:
            _refuse_setting(folder, "scene.path", path, config.scene.path)
    return stored


def is_finished(stored: Stored | None, config: Config) -> bool:
    """Whether a checkpoint is that of the last step."""
    return stored is not None and stored[0]["step"] == config.train.iterations
