"""The runs of a sweep: scenes x settings x seeds, and the folder of each."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from pp_cl import Config
from pp_cl.config import configure, preset
from pp_cl.errors import UserError
from pp_cl.scene import check_folder

Given = tuple[str, str, str]  # key, text of the value, origin, as session.run_config takes them


@dataclass(frozen=True)
class Job:
    """A run of a sweep. scene: absolute folder, or demo; name: the scene's in the table. varied:
    {key: text of the value} of the settings that differ between runs; given: all settings that are
    set. folder: the run's, absolute.
    """

    scene: str
    name: str
    varied: dict[str, str]
    seed: int
    folder: str
    preset: str | None
    given: tuple[Given, ...]
    metrics: tuple[str, ...]

    @property
    def log(self) -> Path:
        """The file beside the job's folder that collects its output."""
        return Path(f"{self.folder}.log")


def read_varied(texts: Sequence[str]) -> dict[str, list[str]]:
    """Parse the texts of --vary to {key: texts of the values}: commas separate values, slashes
    separate the items of a list. Raises UserError naming the part that is wrong.
    """
    varied: dict[str, list[str]] = {}
    for text in texts:
        key, _, values = (part.strip() for part in text.partition("="))
        if not values:
            raise UserError(f"--vary {text}: write --vary section.key=value,value")
        if key in varied:
            raise UserError(f"--vary {text}: {key} is varied already; write its values in one")
        section, _, name = key.partition(".")
        default = getattr(getattr(Config(), section, None), name, None)
        parts = values.split("/" if isinstance(default, tuple) else ",")
        varied[key] = [part.strip() for part in parts]
    return varied


def plan(
    scenes: Sequence[str],
    out: Path | str,
    seeds: Sequence[int],
    varied: Mapping[str, list[str]],
    *,
    given: Sequence[Given] = (),
    preset_name: str | None = None,
    metrics: Sequence[str] = ("psnr", "ssim"),
) -> list[Job]:
    """The jobs: scene by scene, setting by setting, seed by seed.

    given: settings of all runs. Raises UserError if a scene is missing, if settings are invalid, or
    if two runs would have the same folder.
    """
    if "train.seed" in varied:
        raise UserError("--vary train.seed: write the seeds as --seeds")
    taken = {"train.seed": "--seeds"} | dict.fromkeys(varied, "--vary")
    for key, _, origin in given:
        if key in taken:
            raise UserError(f"{origin} {key}: {taken[key]} sets it; leave one of both out")
    jobs: dict[str, Job] = {}
    for scene, *values in itertools.product(scenes, *varied.values()):
        if scene != "demo":
            check_folder(Path(scene))
        name = scene if scene == "demo" else Path(scene).resolve().name
        setting = dict(zip(varied, values, strict=True))
        own = [*given, *((key, text, "--vary") for key, text in setting.items())]
        path = configure(preset(preset_name or "tiny"), scene, own).scene.path
        # a different part of a file's name for each text
        quoted = {key: quote(t, safe=",", errors="surrogateescape") for key, t in setting.items()}
        slug = "_".join(f"{key}={text}" for key, text in quoted.items())
        for seed in seeds:
            folder = Path(out).resolve() / name / slug / f"seed-{seed}"
            seeded = (*own, ("train.seed", str(seed), "--seeds"))
            what = path, name, setting, seed, str(folder), preset_name, seeded, tuple(metrics)
            # two names are one if the file system ignores case
            if jobs.setdefault(str(folder).casefold(), job := Job(*what)) is not job:
                raise UserError(
                    f"{folder}: two runs would be kept there; give each value once, and scenes of"
                    " one name another --out"
                )
    return list(jobs.values())
