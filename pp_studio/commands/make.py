"""`pp-cl make`: from photographs, a video or a scene to a folder that can be sent."""

import argparse
import importlib
import os
import shlex
import time
from pathlib import Path
from typing import Any

from pp_cl.commands import COMMANDS
from pp_cl.commands import options as shared
from pp_cl.config import field_of
from pp_cl.errors import UserError
from pp_studio.capture import STAGES
from pp_studio.commands.capture import add_hints
from pp_studio.export import QUICK

HELP = "photos, a video or a scene to a page, a video and a splat, in one folder"
EPILOG = """FOLDER then holds
  index.html           the result: the model to turn, views beside their photographs, the figures;
                       it is there from the cameras on, and grows
  model.html           the model alone, on one page
  video.mp4, splat.ply once around the object; 3D Gaussians for other viewers
  thumbnail.png        an image of it
  scene, run           what was captured of photographs; the training, which all other commands take
Its parts are capture, train, eval, export and render. The same command goes on where it stopped."""
MINUTES, MOST_MINUTES = 20.0, field_of("train.minutes").metadata["most"]
# the preset of so many minutes: on two cores with AVX-512 the steps of `small` take 7, of `full` 25
PRESET_FROM = {"full": 30.0, "small": 8.0, "tiny": 0.0}
# Of the minutes, those that evaluation, splat and video take after the training: a share of what
# the capture leaves, within these.
AFTER, LEAST_AFTER, MOST_AFTER = 0.25, 1.0, 5.0
LEAST_TRAINING = 0.6  # of what the capture leaves
LEAST_LEFT = 0.25  # of the minutes that a capture leaves, however long it took
PER_PHOTOGRAPH = 0.03  # minutes that a capture takes, about: on two cores with AVX-512
OF_SPLAT = 0.6  # of what is left after the evaluation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("source", metavar="INPUT", help="folder of photographs, a video, a scene, or the word demo")
    add("--out", required=True, metavar="FOLDER", help="folder of the result")
    add(
        "--minutes",
        type=shared.number(0.1, MOST_MINUTES),
        metavar="N",
        help=f"minutes for all of it ({MINUTES:g}); where finding cameras and masks takes most of"
        " them, a quarter comes on top",
    )
    add(
        "--preset",
        choices=list(PRESET_FROM)[::-1],
        help="of the training (by its minutes: tiny below 8, small below 30, then full)",
    )
    add_hints(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Do the steps that are left, and say what to open."""
    from pp_cl import RunFolder, load
    from pp_cl.scene import read_json, scene_splits
    from pp_studio.export.gaussians import fitted_gaussians
    from pp_studio.export.result import INDEX, SPLAT, VIDEOS, begin_result, is_newer, write_result
    from pp_studio.export.result import MINUTES as PASSED
    from pp_studio.video import check_video

    share, out, is_scene = _share(), Path(options.out), _is_scene(options.source)
    if is_scene:
        shared.refuse(options, ("turntable", "mask_command", "box"), "only of photographs")
    begin_result(out)
    device = ["--device", options.device] if options.device else []
    folder, scene, masks = RunFolder(out / "run"), options.source, []
    page, video = out / INDEX, VIDEOS[0]
    told: list[str] = []
    try:
        check_video("mp4")
    except UserError:
        video = VIDEOS[1]

    def show(split=""):
        run = load(folder.path, options.device) if folder.checkpoint.exists() else None
        write_result(run, split, out, video, told, scene)

    with _Clock(out / PASSED, options.minutes) as clock:
        if is_scene:
            masks = ["--masks", options.masks] if options.masks else []
        else:
            scene = str(out / "scene")
            if not Path(scene, "transforms.json").exists():
                clock.tell_of_capture(options.source)
            _step("capture", options.source, "--out", scene, *_hints(options))
            *stages, _ = STAGES  # the last one tells what it has written
            found = {name: read_json(out / f"scene/capture/{name}.json") for name in stages}
            told = [f"{name}: {one['line']}" for name, one in found.items()]
        if not folder.checkpoint.exists():
            show()
            print(f"wrote {page}: open it in a browser; it grows as parts are done")
        if not folder.config.exists():
            training = clock.training()
            chosen = next(n for n, least in PRESET_FROM.items() if share * training >= least)
            preset = ["--preset", options.preset or chosen, "--minutes", f"{training:.3g}"]
        else:  # as it began, unless told otherwise, which train refuses
            preset = ["--preset", options.preset] if options.preset else []
        _step("train", scene, "--out", str(folder), *preset, *masks, *device)
        split = "test" if "test" in scene_splits(scene) else "train"
        show(split)
        print(f"wrote {page}: with the model; figures, splat and video follow")
        _step("eval", str(folder), "--split", split, *device)
        show(split)
        if not is_newer(out / SPLAT, folder.checkpoint):
            # of which export makes the file
            fitted_gaussians(load(folder.path, options.device), QUICK, OF_SPLAT * clock.left)
            words = ["--format", "splat"]
            _step("export", str(folder), "--out", str(out / SPLAT), *words, *device)
            show(split)
        if not is_newer(out / video, folder.checkpoint):
            words = ["--minutes", f"{clock.left:.3g}"]
            _step("render", str(folder), "--out", str(out / video), *words, *device)
            show(split)
    print(
        f"wrote {page} in {clock.passed:.1f} minutes; `pp-cl view {folder}` shows the exact model"
    )


class _Clock:
    """The minutes of all of it: those asked for, and those that have passed, which a file keeps for
    the same command to go on. Raises UserError where others were asked for before.
    """

    def __init__(self, file: Path, asked: float | None) -> None:
        from pp_cl.scene import read_json

        known: dict[str, Any] = read_json(file) if file.exists() else {}
        self.minutes = known.get("asked", asked or MINUTES)
        if asked not in (None, self.minutes):
            raise UserError(
                f"{file.parent}: was begun with --minutes {self.minutes:g}; leave it out, or choose"
                " another --out"
            )
        self._file, self._before = file, known.get("passed", 0.0)
        self._began = time.monotonic()

    def __enter__(self) -> "_Clock":
        return self

    def __exit__(self, *_: object) -> None:
        from pp_cl.files import write_json

        write_json(self._file, {"asked": self.minutes, "passed": round(self.passed, 2)})

    @property
    def passed(self) -> float:
        """Minutes since the beginning, without those between two commands."""
        return self._before + (time.monotonic() - self._began) / 60

    @property
    def left(self) -> float:
        """Minutes that are left, a tenth of one at least."""
        return max(self.minutes - self.passed, 0.1)

    def tell_of_capture(self, source: str) -> None:
        """Say how the minutes are divided, before the photographs are looked at."""
        count = sum(1 for _ in Path(source).glob("*")) if Path(source).is_dir() else 0
        capture = min(PER_PHOTOGRAPH * count or 3.0, self.minutes)
        print(
            f"{self.minutes:g} min: about {capture:.1f} for cameras and masks, a quarter of the"
            " rest for evaluation, splat and video, and what is left for the training",
            flush=True,
        )

    def training(self) -> float:
        """Minutes of the training; says how the rest is divided."""
        left = max(self.minutes - self.passed, LEAST_LEFT * self.minutes)
        after = min(max(AFTER * left, LEAST_AFTER), MOST_AFTER, (1 - LEAST_TRAINING) * left)
        print(
            f"{self.minutes:g} min: {self.passed:.1f} have passed, {left - after:.1f} for the"
            f" training, {after:.1f} for evaluation, splat and video",
            flush=True,
        )
        return left - after


def _share():
    """Of the processor, what others leave: what is running already goes on beside the training."""
    cores = os.cpu_count() or 1
    return cores / (cores + (os.getloadavg()[0] if hasattr(os, "getloadavg") else 0))


def _is_scene(source):
    """Whether it is one that `pp-cl train` reads; else there is no pose yet."""
    from pp_cl.scene import scene_format

    if source != "demo" and not Path(source).exists():
        raise UserError(
            f"{source}: no such folder or video; give photographs, a video or a scene, or demo"
        )
    try:
        return bool(scene_format(source))
    except UserError:
        print(f"{source}: no file of cameras that is known; capture finds them and the masks")
        return False


def _hints(options):
    """The words of a capture."""
    words = []
    if options.turntable is not None:
        words = ["--turntable" if options.turntable else "--no-turntable"]
    if options.masks:
        words += ["--masks", options.masks]
    if options.mask_command:
        words += ["--mask-command", options.mask_command]
    if options.box:
        box = options.box if isinstance(options.box, str) else ",".join(map(repr, options.box))
        words.append(f"--box={box}")
    return words


def _step(name, *words):
    """Run another command, as it would be typed."""
    print(f"== pp-cl {name} {shlex.join(words)}", flush=True)
    module = importlib.import_module(COMMANDS[name])
    parser = argparse.ArgumentParser(prog=f"pp-cl {name}")
    module.add_arguments(parser)
    module.run(parser.parse_args(list(words)))
