"""Reads and checks the settings of a run from presets, command-line texts and config.json."""

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from pp_cl.errors import UserError, one_line, quoted, shown, suggestion
from pp_cl.files.run_folder import RunFolder
from pp_cl.files.untrusted import read_regular
from pp_cl.presets import IMAGE_SIZES, PRESETS
from pp_cl.settings import FORMAT, Config, every_setting

# names that other packages may use; docs/api.md lists them
__all__ = ["PRESETS", "configure", "field_of", "load_config", "preset"]
__all__ += ["refuse_setting", "run_config", "scene_config"]

MOST_BYTES = 2**20  # of a config.json
MOST_TEXT = 4096  # characters of a setting
RANDOM = "random"  # a value of network.start; others are demo and folders
OF_MASKS = ("scene.masks", "scene.ignore", "scene.mask_from", "scene.mask_tolerance")
LENGTH = ("train.minutes", "train.iterations")  # a run has one of them
# settings that runs of 0.3.0 lack, with the values with which they were trained
ADDED: dict[str, Any] = {"train.specular": "off", "train.members": 1, "train.depth_weight": 0.0}
AUTOMATIC = ("train.refine_at", "raster.radius", "train.view_opacity")  # chosen by the hull
MEND_SETTINGS = "restore it or start a new run"

Given = tuple[str, Any, str]  # a setting: key, value or its text, origin


def preset(name: str) -> Config:
    """The Config of a preset. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"--preset {name}: unknown; choose from {', '.join(PRESETS)}")
    config = Config(preset=name)
    for key, value in PRESETS[name].items():
        assign(config, key, value, "preset")
    return config


def assign(config: Config, key: str, value: Any, origin: str) -> None:
    """Set section.key from a value or its text. Raises UserError naming the origin and the key."""
    section, _, name = key.partition(".")
    known = [each for each, _, _ in every_setting(config)]
    if key not in known:
        alike = [each.partition(".")[2] for each in known if each.startswith(f"{section}.")]
        listed = f"{section} has {', '.join(alike)}" if alike else "`train --help` lists them"
        raise UserError(f"{origin}: unknown key {quoted(key)}; {suggestion(key, known)}{listed}")
    owner = getattr(config, section)
    setattr(owner, name, _convert(value, getattr(owner, name), f"{origin}: {key}"))


def _convert(value, example, where):
    """The value, or its text, converted to the type of the example. Raises UserError."""
    if isinstance(example, tuple):
        items = value.split(",") if isinstance(value, str) else value
        if not isinstance(items, (list, tuple)) or len(items) != len(example):
            raise UserError(
                f"{where}: {quoted(value)} is not {len(example)} values separated by commas, like"
                f" {text_of(example)}"
            )
        return tuple(_convert(v, e, where) for v, e in zip(items, example, strict=True))
    kind, convert = KINDS[type(example)]
    try:
        return convert(value)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise UserError(f"{where}: {quoted(value)} is not {kind}") from None


def whole(value: Any) -> int:
    """A whole number, or its text, such as 1e6. Raises ValueError or TypeError for other values."""
    number = finite(value)
    if number != int(number):
        raise ValueError
    return int(number)


def finite(value: Any) -> float:
    """A finite number, or its text. Raises ValueError or TypeError for other values."""
    number = float(value)
    if isinstance(value, bool) or not math.isfinite(number):
        raise ValueError
    return number


def _word(value):
    """A text that the system accepts as a file name. Raises ValueError or TypeError."""
    word = os.fspath(value)
    if not isinstance(word, str) or len(word) > MOST_TEXT or b"\0" in os.fsencode(word):
        raise ValueError
    return word


TRUTHS = {"true": True, "1": True, "false": False, "0": False}
# type of a setting: (its name in errors, conversion of a value or its text)
KINDS = {
    int: ("a whole number", whole),
    float: ("a finite number", finite),
    str: ("a word", _word),
    bool: ("true or false", lambda value: TRUTHS[str(value).lower()]),
}


def validate(config: Config, origin: str, origins: Mapping[str, str] | None = None) -> None:
    """Raise UserError for a value that is not allowed, naming its key and the key's origin in
    `origins`, or else `origin`.
    """

    def where(key):
        return f"{(origins or {}).get(key, origin)}: {key}"

    for key, section, item in every_setting(config):
        _check(getattr(section, item.name), where(key), **item.metadata)
    if config.train.crop % 4:
        raise UserError(
            f"{where('train.crop')} = {config.train.crop}; it must be a multiple of 4"
            " (0: whole images)"
        )
    first, last = config.train.offset_rate
    if (first > 0) != (last > 0):
        raise UserError(
            f"{where('train.offset_rate')} = {first:g},{last:g}; both must be above 0, or neither"
        )


def _check(value, where, *, least, most, choices, **_):
    if choices and value not in choices:
        raise UserError(f"{where} = {quoted(value)}; choose from {', '.join(choices)}")
    several = isinstance(value, tuple)
    if least is not None and not all(least <= v <= most for v in (value if several else (value,))):
        which = "each" if several else "it"
        raise UserError(f"{where} = {text_of(value)}; {which} must lie in [{least}, {most}]")


def configure(config: Config, scene: str, given: Iterable[Given] = ()) -> Config:
    """The config with another scene and the given settings: (key, value or its text, origin). Paths
    of masks inside the old scene's folder move with it. Raises UserError naming the first setting
    that makes no sense, and for scene.path among them.
    """
    given, origins = list(given), dict[str, str]()
    for key, _, origin in given:
        if key == "scene.path":
            raise UserError(f"{origin}: SCENE or --scene gives scene.path; leave it out")
        if key in origins:
            raise UserError(f"{origin}: {key} is set by {origins[key]}, too; leave one out")
        origins[key] = origin
    if origins.keys() >= {*LENGTH}:
        raise UserError(
            f"{origins['train.minutes']}: the iterations follow from the minutes; leave one out"
        )
    path, before = scene if scene == "demo" else str(Path(scene).resolve()), config.scene.path
    for name in ("masks", "ignore"):
        folder = getattr(config.scene, name)
        if folder and before and Path(folder).is_relative_to(before):
            moved = Path(path) / Path(folder).relative_to(before)
            assign(config, f"scene.{name}", str(moved), "settings")
    assign(config, "scene.path", path, "settings")
    for key, value, origin in given:
        if path == "demo" and key in OF_MASKS:
            raise UserError(f"{origin}: the demo has its own masks; leave this out")
        assign(config, key, value, origin)
    folders = (config.scene, "masks"), (config.scene, "ignore"), (config.network, "start")
    for owner, name in folders:
        if getattr(owner, name) not in ("", RANDOM, "demo"):
            setattr(owner, name, str(Path(getattr(owner, name)).resolve()))
    validate(config, "settings", origins)
    return config


def begin_with(path: Path | str, given: list[Given]) -> tuple[str, list[Given]]:
    """(preset, settings) of another run's config.json without its scene's settings, overridden by
    the given ones. Raises UserError as load_config() does.
    """
    config = load_config(path)
    length = "train.minutes" if config.train.minutes else "train.iterations"
    asked = {key for key, _, _ in given}
    left_out = set(LENGTH) if asked & set(LENGTH) else set(LENGTH) - {length}
    left_out |= {*AUTOMATIC} & {*config.decisions}
    settings = [
        (key, getattr(section, item.name), f"--config {path}")
        for key, section, item in every_setting(config)
        if section is not config.scene and key not in left_out | asked
    ]
    return config.preset, settings + given


def load_config(path: Path | str) -> Config:
    """The Config in a config.json. Raises UserError naming the file and the key."""
    path = Path(path)
    try:
        stored = json.loads(read_regular(path, MOST_BYTES))
    except OSError as error:
        mend = nearby_run(path.parent) or "is this the folder of a run?"
        raise UserError(f"{path}: {error.strerror}; {mend}") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({shown(str(error))}); {MEND_SETTINGS}") from None

    def broken(what):
        return UserError(f"{path}: {what}; {MEND_SETTINGS}")

    if not isinstance(stored, dict):
        raise broken(f"not settings but {quoted(stored, 40)}")
    number, name = stored.pop("format", None), stored.pop("preset", None)
    before = stored.pop("automatic", [])  # of 0.4.0: a list of keys
    before = {str(key): "decided by 0.4.0" for key in before} if type(before) is list else before
    decisions = stored.pop("decisions", before)
    if type(number) is not int or number != FORMAT:
        raise UserError(
            f"{path}: format is {quoted(number, 40)}, but this version reads {FORMAT}; start a new"
            " run"
        )
    if type(name) is not str or name not in PRESETS:
        raise broken(f"key preset is missing or not one of {', '.join(PRESETS)}")
    known = [key for key, _, _ in every_setting(Config())]
    if not isinstance(decisions, dict) or not all(
        key in known and isinstance(why, str) for key, why in decisions.items()
    ):
        raise broken(f"decisions are {quoted(decisions, 40)}, not settings with reasons")
    by_key: dict[str, Any] = {}
    for section, values in stored.items():
        if not isinstance(values, dict):
            raise broken(f"{shown(section, 40)} is not a section of settings")
        by_key |= {f"{section}.{key}": value for key, value in values.items()}
    reasons = {key: one_line(why) for key, why in decisions.items()}
    config, by_key = Config(name, reasons), ADDED | by_key
    for key, section, item in every_setting(config):
        if key not in by_key:
            raise broken(f"{key} is missing")
        value = by_key.pop(key)
        if not _is_alike(value, item.default):
            raise broken(f"{key} is {quoted(value, 40)}, not like {text_of(item.default)}")
        setattr(section, item.name, _convert(value, item.default, f"{path}: {key}"))
    if by_key:
        raise broken(f"unknown key {shown(min(by_key), 100)}")
    validate(config, str(path))
    if not config.scene.path:
        raise broken("scene.path is empty")
    return config


def _is_alike(value, example):
    """Whether a JSON value has a setting's type; texts and truth values do not count as numbers."""
    if isinstance(example, tuple):
        return isinstance(value, list) and all(_is_alike(part, example[0]) for part in value)
    return type(value) in ((int, float) if type(example) in (int, float) else (type(example),))


def nearby_run(folder: Path) -> str:
    """A question that suggests the run of a folder's name in runs/; "" if there is none."""
    near = folder.parent / "runs" / folder.name
    return f"did you mean {near}?" if (near / "config.json").is_file() else ""


def text_of(value: Any) -> str:
    """The text of a setting's value that --set accepts."""
    if isinstance(value, tuple):
        return ",".join(map(text_of, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def field_of(key: str) -> dataclasses.Field:
    """The dataclass field of a setting section.key."""
    return {each: item for each, _, item in every_setting(Config())}[key]


def help_lines() -> list[str]:
    """Lines `section.key = default  (help)` for all settings, with the presets' other values."""
    lines = []
    for key, _, item in every_setting(Config()):
        changed = [(name, own[key]) for name, own in PRESETS.items() if key in own]
        others = "".join(f"  {name}: {text_of(value)}" for name, value in changed)
        lines.append(f"  {key} = {text_of(item.default)}  ({item.metadata['help']}){others}")
    return lines


# ---- the settings of a training in a folder: of a new training, or of one that continues

# settings that may change between checkpoints: paths, since the checkpoint knows its scene by more
# than its path, and settings that do not affect the model
FREE = (
    *("scene.path", "scene.masks", "scene.ignore", "train.memory_gib", "train.eval_every"),
    *("train.log_every", "train.checkpoint_every", "train.checkpoint_minutes"),
)


def run_config(
    folder: RunFolder,
    scene: str,
    preset_name: str | None = None,
    given: Iterable[Given] = (),
) -> Config:
    """The Config of a training in `folder`: the run's there, or else the preset's, with the given
    settings: (key, value or its text, origin). They must not change a run that has a checkpoint,
    except for FREE settings and the length of a finished run. Raises UserError naming the first
    setting that differs or makes no sense, or the fault in the scene's files.
    """
    given, stored = list(given), load_config(folder.config) if folder.config.exists() else None
    other_preset = stored is not None and preset_name not in (None, stored.preset)
    if stored and folder.checkpoint.exists():
        if other_preset:
            raise UserError(
                f"{folder.config}: preset is {stored.preset} in this run, but {preset_name} is"
                " asked for; use another --out"
            )
        return _resumed(folder, stored, scene, given)
    if not stored or other_preset:
        return scene_config(scene, preset_name or "tiny", given)
    # the training was stopped before its first checkpoint: automatic settings are chosen again
    for key in [key for key in stored.decisions if key != "scene.downscale"]:
        if key in AUTOMATIC:
            assign(stored, key, field_of(key).default, "preset")
        del stored.decisions[key]
    if "train.iterations" in [key for key, _, _ in given]:
        stored.train.minutes = 0.0
    return configure(stored, scene, given)


def scene_config(scene: str, preset_name: str, given: Iterable[Given] = ()) -> Config:
    """The Config of a preset for a scene, with the given settings. Unless these set
    scene.downscale, images are reduced to about the preset's size. Raises UserError as configure()
    and scene_frames() do.
    """
    # here, so that --help needs neither numpy nor OpenCL
    from pp_cl.engine.views import MIN_SIDE, fitting_downscale
    from pp_cl.scene.listing import scene_frames

    given = list(given)
    config = configure(preset(preset_name), scene, given)
    if "scene.downscale" not in [key for key, _, _ in given]:
        cameras = [image_file.camera for image_file in scene_frames(config.scene.path)]
        sizes = [(camera.width, camera.height) for camera in cameras]
        fitting = fitting_downscale(max(sizes, key=max), IMAGE_SIZES[preset_name])
        most = max(1, min(map(min, sizes)) // MIN_SIDE)
        assign(config, "scene.downscale", min(fitting, most), "preset")
        why = f"for the preset {preset_name} (--downscale 1 keeps them)"
        config.decisions["scene.downscale"] = (
            f"size: images reduced {min(fitting, most)} times {why}"
        )
    return config


def _resumed(folder, stored, scene, given):
    """The settings of a run with a checkpoint: FREE may change, and LENGTH if it is finished."""
    from pp_cl.checkpoint import opened_run
    from pp_cl.engine.render import is_supersampled

    config, free = configure(load_config(folder.config), scene, given), {*FREE}
    if not is_supersampled(config.raster):  # the setting has no effect, and the run has stored 0
        config.train.supersampled = stored.train.supersampled
    if config.train.iterations != stored.train.iterations:
        with opened_run(folder, stored) as run:
            if run.header["finished"]:
                free |= {*LENGTH}
                config.train.minutes = 0.0
    for key, section, item in every_setting(config):
        there = getattr(getattr(stored, key.partition(".")[0]), item.name)
        asked = getattr(section, item.name)
        if key in AUTOMATIC and key in stored.decisions and asked == item.default:
            setattr(section, item.name, there)  # what the training has chosen
        elif asked != there and key not in free:
            refuse_setting(folder, key, there, asked)
    return config


def refuse_setting(folder: RunFolder, key: str, there: Any, asked: Any) -> NoReturn:
    """Raise UserError: the training in the folder has another value of a setting."""
    raise UserError(
        f"{folder.config}: {key} is {there} in this run, but {asked} is asked for; use another"
        " --out, or the settings of the run"
    )
