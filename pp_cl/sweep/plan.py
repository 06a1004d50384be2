"""The runs of a sweep: scenes x settings x seeds, and the folder of each."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from pp_cl.config import Config, assign, configure, preset, sections, text_of
from pp_cl.errors import UserError
from pp_cl.scene.load import DEMO, check_folder

Given = tuple[str, str, str]  # key, text of the value, origin, as session.run_config takes them

# Settings that tell the runs of a sweep apart by other means: what to write instead.
TAKEN = {"train.seed": "--seeds", "scene.path": "more scenes as arguments"}


@dataclass(frozen=True)
class Job:
    """A run of a sweep. scene: absolute folder, or demo; name: the scene in the table. varied:
    (key, text of the value) of what differs between the settings; given: all that is set. folder:
    of the run, absolute; iterations: of its training, 0 where minutes are
    given.
    """

    scene: str
    name: str
    varied: tuple[tuple[str, str], ...]
    seed: int
    folder: str
    preset: str | None
    given: tuple[Given, ...]
    metrics: tuple[str, ...]
    iterations: int

    def __str__(self) -> str:
        setting = (f"{key}={text}" for key, text in self.varied)
        return " ".join([self.name, *setting, f"seed {self.seed}"])

    @property
    def log(self) -> Path:
        """What is printed while the job runs, beside its folder."""
        return Path(f"{self.folder}.log")


def read_varied(texts: Sequence[str]) -> list[tuple[str, list[str]]]:
    """[(key, texts of the values)] of the texts of --vary: values are separated by commas, those of
    a setting that is a list itself by slashes. Raises UserError naming what makes no sense.
    """
    varied: dict[str, list[str]] = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not equals or not values:
            raise UserError(f"--vary {text}: write --vary section.key=value,value")
        if key in varied:
            raise UserError(f"--vary {text}: {key} is varied already; write its values in one")
        _check_free(key, f"--vary {text}")
        parts = values.split("/" if isinstance(_value(Config(), key), tuple) else ",")
        varied[key] = [_canonical(key, part.strip()) for part in parts]
        twice = [value for value in varied[key] if varied[key].count(value) > 1]
        if twice:
            raise UserError(f"--vary {text}: {twice[0]} stands there twice")
    return list(varied.items())


def _canonical(key, text):
    """The value's text as the program writes it: 1e3 and 1000 are one value."""
    config = Config()
    assign(config, key, text, "--vary")
    return text_of(_value(config, key))


def _value(config, key):
    """The value of section.key; None where there is no such setting."""
    section, _, name = key.partition(".")
    return getattr(dict(sections(config)).get(section), name, None)


def _check_free(key, origin):
    if key in TAKEN:
        raise UserError(f"{origin}: {key} cannot be set in a sweep; write {TAKEN[key]}")


def plan(
    scenes: Sequence[str],
    out: Path | str,
    seeds: Sequence[int],
    varied: Sequence[tuple[str, list[str]]],
    *,
    given: Sequence[Given] = (),
    preset_name: str | None = None,
    metrics: Sequence[str] = ("psnr", "ssim"),
) -> list[Job]:
    """The jobs: scene by scene, setting by setting, seed by seed.

    given: what all runs share. Raises UserError for scenes that are missing or share a name, and
    for settings that make no sense.
    """
    for key, _, origin in given:
        _check_free(key, origin)
        if key in dict(varied):
            raise UserError(f"{origin} {key}: is varied too; leave one of both out")
    jobs = []
    keys = [key for key, _ in varied]
    for scene, name in _names(scenes).items():
        for values in itertools.product(*(values for _, values in varied)):
            setting = tuple(zip(keys, values, strict=True))
            own = [*given, *((key, text, "--vary") for key, text in setting)]
            config = configure(preset(preset_name or "tiny"), scene, own)
            folder = Path(out).resolve() / name
            if setting:
                folder /= "_".join(f"{key}={_file_name(text)}" for key, text in setting)
            jobs += [
                Job(
                    scene=config.scene.path,
                    name=name,
                    varied=setting,
                    seed=seed,
                    folder=str(folder / f"seed-{seed}"),
                    preset=preset_name,
                    given=(*own, ("train.seed", str(seed), "--seeds")),
                    metrics=tuple(metrics),
                    iterations=0 if config.train.minutes else config.train.iterations,
                )
                for seed in seeds
            ]
    return jobs


def _names(scenes):
    """{scene: name}, in order. Names must differ, also where the file system ignores case."""
    names, taken = {}, {}
    for scene in scenes:
        if scene != DEMO:
            check_folder(Path(scene))
        name = DEMO if scene == DEMO else Path(scene).resolve().name
        other = taken.setdefault(name.casefold(), scene)
        if other != scene:
            raise UserError(
                f"{scene}: is called {name}, as {other} is, and runs are kept under the name;"
                " rename one, or sweep it into another --out"
            )
        names[scene] = name
    return names


def _file_name(text):
    """A text as part of a file's name, another one for each text."""
    return quote(text, safe=",", errors="surrogateescape")
