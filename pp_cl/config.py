"""Reads the settings of a run from presets, command-line texts and config.json, and checks them;
errors name the setting.
"""

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from pp_cl.checkpoint import opened_run
from pp_cl.engine.views import MIN_SIDE, fitting_downscale
from pp_cl.errors import UserError, quoted, shown, suggestion
from pp_cl.files.run_folder import RunFolder
from pp_cl.files.untrusted import read_regular
from pp_cl.presets import IMAGE_SIZES, PRESETS
from pp_cl.scene.load import scene_frames
from pp_cl.settings import FORMAT, Config, sections

# what other packages may use; docs/api.md lists it
__all__ = ["PRESETS", "assign", "configure", "field_of", "load_config"]
__all__ += ["preset", "preset_downscale", "run_config"]

MOST_BYTES = 2**20  # of a config.json
MOST_TEXT = 4096  # characters of a setting
RANDOM = "random"  # of network.start, beside demo and a folder
OF_MASKS = ("scene.masks", "scene.ignore", "scene.mask_from", "scene.mask_tolerance")
LENGTH = ("train.minutes", "train.iterations")  # of which a run has one
OPEN = ("train.refine_at", "raster.radius")  # that a training decides where they are 0
MEND_SETTINGS = "restore it or start a new run"


def preset(name: str) -> Config:
    """Config of a preset. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"--preset {name}: unknown; choose from {', '.join(PRESETS)}")
    config = Config(preset=name)
    for key, value in PRESETS[name].items():
        assign(config, key, value, "preset")
    return config


def assign(config: Config, key: str, value: Any, origin: str) -> None:
    """Set section.key from a value or its text. Raises UserError naming the origin and the key."""
    section, _, name = key.partition(".")
    owner = dict(sections(config)).get(section)
    if owner is None or name not in vars(owner):
        near = suggestion(key, (f"{s}.{name}" for s, v in sections(config) for name in vars(v)))
        known = f"{section} has {', '.join(vars(owner))}" if owner else "`train --help` lists them"
        raise UserError(f"{origin}: unknown key {quoted(key)}; {near}{known}")
    setattr(owner, name, _convert(value, getattr(owner, name), f"{origin}: {key}"))


def _convert(value, example, where):
    """The value, or its text, as the type of the example. Raises UserError."""
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
    """A whole number, or its text, as 1e6. Raises ValueError or TypeError for anything else."""
    number = finite(value)
    if number != int(number):
        raise ValueError
    return int(number)


def finite(value: Any) -> float:
    """A finite number, or its text. Raises ValueError or TypeError for anything else."""
    number = float(value)
    if isinstance(value, bool) or not math.isfinite(number):
        raise ValueError
    return number


def _word(value):
    """A text that a system can take as the name of a file."""
    word = os.fspath(value)
    if not isinstance(word, str) or len(word) > MOST_TEXT or b"\0" in os.fsencode(word):
        raise ValueError
    return word


def _truth(value):
    return {"true": True, "1": True, "false": False, "0": False}[str(value).lower()]


# type of a setting: (its name in errors, conversion of a value or its text)
KINDS = {
    int: ("a whole number", whole),
    float: ("a finite number", finite),
    str: ("a word", _word),
    bool: ("true or false", _truth),
}


def validate(config: Config, origin: str, origins: Mapping[str, str] | None = None) -> None:
    """Raise UserError naming the origin and the first key whose value is not allowed. origins: of
    keys that come from elsewhere.
    """

    def where(key):
        return f"{(origins or {}).get(key, origin)}: {key}"

    for section, values in sections(config):
        for item in dataclasses.fields(values):
            key = f"{section}.{item.name}"
            _check(getattr(values, item.name), where(key), **item.metadata)
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


def configure(config: Config, scene: str, given: Iterable[tuple[str, Any, str]] = ()) -> Config:
    """The config with another scene, to which masks in its folder move along, and the given
    settings: (key, value or its text, origin).

    Raises UserError naming the first that makes no sense, and for scene.path among them.
    """
    given, origins = list(given), dict[str, str]()
    for key, _, origin in given:
        if key == "scene.path":
            raise UserError(f"{origin}: scene.path is what SCENE or --scene says; leave it out")
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
            raise UserError(f"{origin}: the demo has masks of its own; leave it out")
        assign(config, key, value, origin)
    folders = (config.scene, "masks"), (config.scene, "ignore"), (config.network, "start")
    for owner, name in folders:
        if getattr(owner, name) not in ("", RANDOM, "demo"):
            setattr(owner, name, str(Path(getattr(owner, name)).resolve()))
    validate(config, "settings", origins)
    return config


def begin_with(
    path: Path | str, given: list[tuple[str, Any, str]]
) -> tuple[str, list[tuple[str, Any, str]]]:
    """(preset, settings) of another run's config.json, all but those of its scene, with the given
    ones on top: (key, value or its text, origin). Raises UserError as load_config.
    """
    config = load_config(path)
    length = "train.minutes" if config.train.minutes else "train.iterations"
    asked = {key for key, _, _ in given}
    left_out = set(LENGTH) if asked & set(LENGTH) else set(LENGTH) - {length}
    left_out |= {*config.decided}
    settings = [
        (f"{section}.{name}", value, f"--config {path}")
        for section, values in sections(config)
        for name, value in vars(values).items()
        if section != "scene" and f"{section}.{name}" not in left_out | asked
    ]
    return config.preset, settings + given


def load_config(path: Path | str) -> Config:
    """Config of a config.json. Raises UserError naming the file and the key."""
    path = Path(path)
    try:
        stored = json.loads(read_regular(path, MOST_BYTES))
    except OSError as error:
        mend = nearby_run(path.parent) or "is this the folder of a run?"
        raise UserError(f"{path}: {error.strerror}; {mend}") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({shown(str(error))}); {MEND_SETTINGS}") from None
    if not isinstance(stored, dict):
        raise UserError(f"{path}: not settings but {quoted(stored, 40)}; {MEND_SETTINGS}")
    number, name = stored.pop("format", None), stored.pop("preset", None)
    decided = stored.pop("decided", [])
    if type(number) is not int or number != FORMAT:
        raise UserError(
            f"{path}: format is {quoted(number, 40)}, this version reads {FORMAT}; start a new run"
        )
    if type(name) is not str or name not in PRESETS:
        raise UserError(
            f"{path}: key preset is missing or none of {', '.join(PRESETS)}; {MEND_SETTINGS}"
        )
    if not isinstance(decided, list) or not all(key in OPEN for key in decided):
        raise UserError(
            f"{path}: decided is {quoted(decided, 40)}, no list of {', '.join(OPEN)};"
            f" {MEND_SETTINGS}"
        )
    config = preset(name)
    config.decided = decided
    ours = dict(sections(config))
    for section, values in stored.items():
        where = f"{path}: {shown(section, 40)}"
        if section not in ours or not isinstance(values, dict):
            raise UserError(f"{where} is no section of settings; {MEND_SETTINGS}")
        if unknown := sorted(values.keys() - vars(ours[section]).keys()):
            key = f"{section}.{shown(unknown[0], 60)}"
            raise UserError(f"{path}: unknown key {key}; {MEND_SETTINGS}")
    for section, own in ours.items():
        for key, example in vars(own).items():
            where = f"{path}: {section}.{key}"
            if key not in stored.get(section, {}):
                raise UserError(f"{where} is missing; {MEND_SETTINGS}")
            value = stored[section][key]
            if not _is_alike(value, example):
                raise UserError(
                    f"{where} is {quoted(value, 40)}, not like {text_of(example)}; {MEND_SETTINGS}"
                )
            setattr(own, key, _convert(value, example, where))
    validate(config, str(path))
    if not config.scene.path:
        raise UserError(f"{path}: scene.path is empty; {MEND_SETTINGS}")
    return config


def _is_alike(value, example):
    """Whether a value of JSON is of a setting's type: texts and truth values are no numbers."""
    if isinstance(example, tuple):
        return isinstance(value, list) and all(_is_alike(one, example[0]) for one in value)
    return type(value) in ((int, float) if type(example) in (int, float) else (type(example),))


def nearby_run(folder: Path) -> str:
    """What to say of a folder that is no run's where the one of its name in runs/ is, else ""."""
    near = folder.parent / "runs" / folder.name
    return f"did you mean {near}?" if (near / "config.json").is_file() else ""


def text_of(value: Any) -> str:
    """The value of a setting as --set takes it."""
    if isinstance(value, tuple):
        return ",".join(map(text_of, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def field_of(key: str) -> dataclasses.Field:
    """The dataclass field of a setting section.key."""
    section, _, name = key.partition(".")
    return next(f for f in dataclasses.fields(getattr(Config(), section)) if f.name == name)


def help_lines() -> list[str]:
    """Lines `section.key = default  (help)` of all settings, each with the values of the presets
    that differ: the text of `--help`.
    """
    return [
        f"  {section}.{item.name} = {text_of(item.default)}  ({item.metadata['help']})"
        + "".join(
            f"  {name}: {text_of(changes[key])}"
            for name, changes in PRESETS.items()
            if (key := f"{section}.{item.name}") in changes
        )
        for section, values in sections(Config())
        for item in dataclasses.fields(values)
    ]


# ---- the settings of a training in a folder: of a new one, or of one that goes on

# settings that a checkpoint may go on with others of: places, which it knows by more than that, and
# what the model does not depend on
FREE = (
    *("scene.path", "scene.masks", "scene.ignore", "train.memory_gib", "train.eval_every"),
    *("train.log_every", "train.checkpoint_every", "train.checkpoint_minutes"),
)


def run_config(
    folder: RunFolder,
    scene: str,
    preset_name: str | None = None,
    given: Iterable[tuple[str, Any, str]] = (),
    *,
    extends: bool = False,
) -> Config:
    """Config of a training in `folder`: that of the run which has a checkpoint there, else the
    preset's, with the given settings.

    scene: a folder, or the word demo. given: (key, value or its text, origin); a run that has a
    checkpoint must have the same values. extends: whether train.iterations of a finished run may
    change: with more of them it goes on, with fewer it stays finished. Raises UserError naming the
    first setting that differs or makes no sense, or what is wrong with the scene's files.
    """
    given = list(given)
    if folder.config.exists() and folder.checkpoint.exists():
        return _config_to_resume(folder, scene, preset_name, given, extends)
    return _config_to_begin(folder, scene, preset_name, given)


def _config_to_begin(folder, scene, preset_name, given):
    """That of a run that was stopped before its first checkpoint, if it is of this preset; else the
    preset's, which reduces the images to about its size unless scene.downscale is given.
    """
    if folder.config.exists():
        stored = load_config(folder.config)
        if preset_name in (None, stored.preset):
            for key in stored.decided:  # of other images, maybe
                assign(stored, key, field_of(key).default, "preset")
            if "train.iterations" in [key for key, _, _ in given]:
                stored.train.minutes = 0
            return configure(stored, scene, given)
    config = configure(preset(preset_name or "tiny"), scene, given)
    if "scene.downscale" not in [key for key, _, _ in given]:
        downscale = preset_downscale(config.scene.path, config.preset)
        assign(config, "scene.downscale", downscale, "preset")
    return config


def _config_to_resume(folder, scene, preset_name, given, extends):
    """That of the run, which may change in nothing but the iterations of a finished one."""
    stored, config = load_config(folder.config), load_config(folder.config)
    if preset_name not in (None, stored.preset):
        raise UserError(
            f"{folder.config}: preset is {stored.preset} there, {preset_name} asked for; use"
            " another --out"
        )
    configure(config, scene, given)
    if stored.train.minutes:  # planned meanwhile, as train.iterations are
        config.train.refine_at = stored.train.refine_at
    if extends and config.train.iterations != stored.train.iterations:
        with opened_run(folder, stored) as run:
            if run.header["step"] == stored.train.iterations:
                most = max(config.train.iterations, stored.train.iterations)
                for one in (config, stored):
                    assign(one, "train.iterations", most, "settings")
                    assign(one, "train.minutes", 0, "settings")
    _check_same(config, stored, folder)
    return config


def _check_same(asked, stored, folder):
    """Raise UserError naming the first setting that differs, but for those of FREE."""
    for (section, ours), (_, theirs) in zip(sections(asked), sections(stored), strict=True):
        for name, value in vars(ours).items():
            there = getattr(theirs, name)
            if value != there and f"{section}.{name}" not in FREE:
                refuse_setting(folder, f"{section}.{name}", there, value)


def refuse_setting(folder: RunFolder, key: str, there: Any, asked: Any) -> NoReturn:
    """Raise UserError: a training in the folder has another value of a setting."""
    raise UserError(
        f"{folder.config}: {key} is {there} there, {asked} asked for; use another --out, or the"
        " settings of the run"
    )


def preset_downscale(path: str, preset: str) -> int:
    """How many times a preset reduces the images of a scene, by the size of the largest training
    image that leaves the smallest enough pixels. Raises UserError as scene_frames does.
    """
    cameras = [one.camera for one in scene_frames(path)]
    sizes = [(camera.width, camera.height) for camera in cameras]
    fitting = fitting_downscale(max(sizes, key=max), IMAGE_SIZES[preset])
    return max(1, min(fitting, min(map(min, sizes)) // MIN_SIDE))
