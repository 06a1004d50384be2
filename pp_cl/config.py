"""All settings of a run, from presets, texts and JSON, which lies beside the result."""

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pp_cl.errors import UserError
from pp_cl.presets import ABSENT, PRESETS, RENAMED
from pp_cl.settings import NetworkConfig, PointsConfig, RasterConfig, SceneConfig, TrainConfig


@dataclass
class Config:
    """All settings of a run. notes: what the user should be told about how they were read."""

    preset: str = "tiny"
    scene: SceneConfig = field(default_factory=SceneConfig)
    points: PointsConfig = field(default_factory=PointsConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    notes: list[str] = field(default_factory=list, compare=False)

    def to_json(self) -> str:
        """The settings as JSON text: {"preset": name, section: {name: value}}."""
        stored = dataclasses.asdict(self)
        del stored["notes"]
        return json.dumps(stored, indent=1)


def preset(name: str) -> Config:
    """Config of a preset. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"--preset {name}: unknown; choose from {', '.join(PRESETS)}")
    config = Config(preset=name)
    for key, value in PRESETS[name].items():
        assign(config, key, value, "preset")
    return config


def sections(config: Config) -> Iterator[tuple[str, Any]]:
    """(name, dataclass) of each section, in their order."""
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            yield name, value


def assign(config: Config, key: str, value: Any, origin: str) -> None:
    """Set section.key from a value or its text; an old key sets the new one and leaves a note.
    Raises UserError naming the origin and the key.
    """
    if key in RENAMED:
        config.notes.append(f"{origin}: {key} is called {RENAMED[key]} now")
    section, _, name = RENAMED.get(key, key).partition(".")
    owner = dict(sections(config)).get(section)
    if owner is None:
        raise UserError(f"{origin}: unknown key {key!r}; keys look like train.iterations")
    if name not in vars(owner):
        raise UserError(f"{origin}: unknown key {key!r}; {section} has {', '.join(vars(owner))}")
    setattr(owner, name, _convert(value, getattr(owner, name), f"{origin}: {key}"))


def _convert(value, example, where):
    """The value, or its text, as the type of the example. Raises UserError."""
    if isinstance(example, tuple):
        items = value.split(",") if isinstance(value, str) else value
        if not isinstance(items, (list, tuple)) or len(items) != len(example):
            raise UserError(
                f"{where}: {value!r} is not {len(example)} values separated by commas, like"
                f" {text_of(example)}"
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


def _truth(value):
    return {"true": True, "1": True, "false": False, "0": False}[str(value).lower()]


# type of a setting: (its name in errors, conversion of a value or its text)
KINDS = {
    int: ("a whole number", _whole),
    float: ("a finite number", _finite),
    str: ("a word", str),
    bool: ("true or false", _truth),
}


def validate(config: Config, origin: str) -> None:
    """Raise UserError naming the origin and the first key whose value is not allowed."""
    for section, values in sections(config):
        for item in dataclasses.fields(values):
            _check(getattr(values, item.name), f"{origin}: {section}.{item.name}", **item.metadata)
    if config.train.crop % 4:
        raise UserError(
            f"{origin}: train.crop = {config.train.crop}; it must be a multiple of 4"
            " (0: whole images)"
        )


def _check(value, where, *, least, most, choices, **_):
    if choices and value not in choices:
        raise UserError(f"{where} = {value!r}; choose from {', '.join(choices)}")
    several = isinstance(value, tuple)
    if least is not None and not all(least <= v <= most for v in (value if several else (value,))):
        which = "each" if several else "it"
        raise UserError(f"{where} = {text_of(value)}; {which} must lie in [{least}, {most}]")


def configure(config: Config, scene: str, given: Iterable[tuple[str, Any, str]] = ()) -> Config:
    """The config with another scene and the given settings: (key, value or its text, origin).

    Raises UserError naming the first that makes no sense.
    """
    path = scene if scene == "demo" else str(Path(scene).resolve())
    assign(config, "scene.path", path, "settings")
    for key, value, origin in given:
        assign(config, key, value, origin)
    if config.scene.masks:
        assign(config, "scene.masks", str(Path(config.scene.masks).resolve()), "settings")
    validate(config, "settings")
    return config


def load_config(path: Path | str) -> Config:
    """Config of a config.json; old keys leave one note in all. Raises UserError naming the file
    and the key.
    """
    path = Path(path)
    try:
        stored = json.loads(path.read_text())
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; is this the folder of a run?") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({error}); restore it or start a new run") from None
    if not isinstance(stored, dict) or stored.get("preset") not in tuple(PRESETS):
        raise UserError(
            f"{path}: key preset is missing or none of {', '.join(PRESETS)}; restore it or start a"
            " new run"
        )
    config = preset(stored.pop("preset"))
    for key, value in ABSENT.items():
        assign(config, key, value, str(path))
    for section, values in stored.items():
        if not isinstance(values, dict):
            raise UserError(f"{path}: {section} is not an object")
        for name, value in values.items():
            assign(config, f"{section}.{name}", value, str(path))
    if len(config.notes) > 1:
        config.notes[:] = [
            f"{config.notes[0]}, {len(config.notes) - 1} other keys were renamed too"
        ]
    validate(config, str(path))
    return config


def text_of(value: Any) -> str:
    """The value of a setting as --set takes it."""
    if isinstance(value, tuple):
        return ",".join(map(text_of, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def help_lines() -> list[str]:
    """Lines `section.key = default  (help)` of all settings: the text of `--help`."""
    return [
        f"  {section}.{item.name} = {text_of(item.default)}  ({item.metadata['help']})"
        for section, values in sections(Config())
        for item in dataclasses.fields(values)
    ]
