"""`pp-cl make`: turns photographs, a video or a scene into a folder to send to others."""

import argparse
import hashlib
import importlib
import itertools
import os
import shlex
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pp_cl.commands import COMMANDS
from pp_cl.commands import options as shared
from pp_cl.config import PRESETS, field_of
from pp_cl.errors import Stopped, UserError, pasted
from pp_studio.capture import STAGES
from pp_studio.commands.capture import add_hints
from pp_studio.export import QUICK

if TYPE_CHECKING:
    from pp_cl import RunFolder

HELP = "photos, a video or a scene to a page, a video and a splat, in one folder"
EPILOG = """FOLDER then holds
  index.html           the result: the model to turn, views beside their photographs, the figures;
                       it is there once masks are made, shows what there is, and reloads itself
  model.html           the model alone, on one page
  video.mp4, splat.ply once around the object; 3D Gaussians for other viewers
  thumbnail.png        an image of it
  scene, run           what was captured of photographs; the training, which all other commands take
Its parts are capture, train, eval, export and render. The same command goes on where it stopped."""
MINUTES, MOST_MINUTES = 20.0, field_of("train.minutes").metadata["most"]
# Evaluation, splat and video, after the training, take this share of the minutes that the capture
# leaves, within these bounds in minutes.
AFTER, LEAST_AFTER, MOST_AFTER = 0.25, 1.0, 5.0
LEAST_TRAINING = 0.6  # share of the minutes that the capture leaves
# At least this share of the minutes is left after a capture: training then gets a third of all.
LEAST_LEFT = 5 / 9
LEAST_MORE = 0.1  # minutes that must be left for a finished training to go on
LATE = 0.8  # the time per step is measured after this share of a training
PER_PHOTOGRAPH = 0.05  # minutes that a capture takes for each, about, on two cores without AVX-512
MOST_GAUSSIANS = 180_000  # of the splat: a page of them has 9.7 MB
MARKED = 2**16  # bytes of a checkpoint's end
RESTS = 16.0  # an open page is renewed at most after so many times the seconds that this takes
OF_SPLAT = 0.6  # share of the minutes left after the evaluation
# of a training on photographs: poses are not exact, and surfaces would have pits
SMOOTH = ["--set", "train.depth_weight=0.001"]
# With so many times its minutes, a model is trained anew, as they allow for larger images: in more
# steps on images as small, it would only learn its photographs by heart.
ANEW = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("source", metavar="INPUT", help="folder of photographs, a video, a scene, or the word demo")
    add("--out", required=True, metavar="FOLDER", help="folder of the result")
    add(
        "--minutes",
        type=shared.number(0.1, MOST_MINUTES),
        metavar="N",
        help=f"minutes for all of it ({MINUTES:g}; the training gets at least a third of them, also"
        " where cameras and masks take longer); with more of them a finished model is trained on,"
        " or, if they allow for larger images, anew",
    )
    add(
        "--preset",
        choices=PRESETS,
        help="of the training (if it is not given, the images' size goes by the minutes)",
    )
    add("--title", metavar="TEXT", help="of the page (the name of FOLDER)")
    add_hints(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Run the steps that are not done yet, and say what to open."""
    from pp_cl import RunFolder, load
    from pp_cl.files import write_json
    from pp_cl.scene import read_json, scene_splits
    from pp_studio.export import length
    from pp_studio.export.gaussians import fitted_gaussians
    from pp_studio.export.result import (
        INDEX,
        MODEL,
        SPLAT,
        STATE,
        STILL,
        VIDEOS,
        begin_result,
        is_newer,
        write_preview,
        write_result,
    )
    from pp_studio.video import check_video

    out, is_scene = Path(options.out), _is_scene(options.source)
    if is_scene:
        shared.refuse(options, ("turntable", "mask_command", "box"), "only of photographs")
    begin_result(out)
    device = ["--device", options.device] if options.device else []
    folder, scene = RunFolder(out / "run"), options.source
    page, video = out / INDEX, VIDEOS[0]
    masks: list[str] = []
    summaries: list[str] = []
    try:
        check_video("mp4")
    except UserError:
        video = VIDEOS[1]

    with _Clock(out / STATE, options.minutes, options.title) as clock:

        def show(state="", split=""):
            run = load(folder.path, options.device) if split else None
            state = state and f"{state} {clock.told}; this page renews itself."
            facts = {"run": run, "split": split, "scene": scene, "told": summaries, "state": state}
            write_result(out, clock.title, video, **facts)

        def step(name, *words, **more):
            _step(name, *words, note=clock.told, **more)
            clock.keep()

        def follow(training):
            ended = took = 0.0

            def renew():
                nonlocal ended, took
                if (began := time.monotonic()) < ended + RESTS * took:
                    return
                try:
                    write_preview(training, out, clock.title)
                    show(f"In training, at step {training.trainer.step}.")
                except (UserError, MemoryError) as error:  # must not end a training
                    warnings.warn(f"{page} is not renewed in the training: {error}", stacklevel=2)
                    training.on_preview = None
                ended = time.monotonic()
                took = ended - began

            training.on_preview = renew

        def train(*words, follow=follow):
            more = {"follow": follow} if follow else {}
            step("train", scene, "--out", str(folder), *words, *masks, *device, **more)

        if clock.is_renamed:
            (out / MODEL).unlink(missing_ok=True)
        if is_scene:
            masks = ["--masks", options.masks] if options.masks else []
        else:
            scene = str(out / "scene")
            if not Path(scene, "transforms.json").exists():
                clock.tell_of_capture(options.source)
            written = _written(scene)
            step("capture", options.source, "--out", scene, *_hints(options), *device)
            if folder.checkpoint.exists() and _written(scene) != written:
                print(f"the scene has changed; {_set_aside(folder)} is its model", flush=True)
            *stages, _ = STAGES  # the last one prints what it has written
            records = {name: read_json(out / f"scene/capture/{name}.json") for name in stages}
            summaries = [f"{name}: {record['line']}" for name, record in records.items()]
        preset = ["--preset", options.preset] if options.preset else []
        smooth = [] if is_scene else SMOOTH
        if not folder.checkpoint.exists():
            show("Cameras and masks are found.")
            print(f"wrote {page}: open it in a browser; it grows by itself", flush=True)
            if not (out / MODEL).exists() and _wrote_hull(out, scene, clock.title, options, masks):
                show("So far this is the object's outline in the colours of the photographs.")
        if not folder.config.exists() or (options.preset and not folder.checkpoint.exists()):
            minutes = clock.training()
            train(*preset, *smooth, "--minutes", f"{minutes:.3g}")
        else:  # keep the run's preset; train refuses another
            train(*preset, *clock.iterations())
        if minutes := clock.more(folder):
            end, config = folder.rows()[-1], read_json(folder.config)
            is_longer = 60 * minutes >= ANEW * end["seconds"]
            if not preset and config["scene"]["downscale"] > 1 and is_longer:
                kept = _set_aside(folder)
                print(f"trained anew, in more minutes; {kept} is the model so far", flush=True)
                # an open page keeps that model, which is better than the new one's first previews
                train(*smooth, "--minutes", f"{minutes:.3g}", follow=None)
                if (known := kept / length.FILE).exists():  # the scene and its unit are the same
                    write_json(folder.path / length.FILE, read_json(known))
            else:
                train(*clock.extended(folder, minutes))
        split = "test" if "test" in scene_splits(scene) else "train"
        show("Trained; the figures follow.", split)
        print(f"wrote {page}: with the model; figures, splat and video follow", flush=True)
        step("eval", str(folder), "--split", split, *device)
        made = [out / name for name in (SPLAT, video, STILL, MODEL) if (out / name).exists()]
        is_copied = not all(is_newer(file, folder.checkpoint) for file in made)
        if is_copied and clock.made_of == _mark(folder.checkpoint):
            for file in made:  # in a copy of the folder, the checkpoint may be the newest file
                file.touch()
        if not is_newer(out / SPLAT, folder.checkpoint):
            show("Trained and measured; splat and video follow.", split)
            # export writes these Gaussians to the file
            limits = OF_SPLAT * clock.left, MOST_GAUSSIANS
            fitted_gaussians(load(folder.path, options.device), QUICK, *limits)
            words = ["--format", "splat"]
            step("export", str(folder), "--out", str(out / SPLAT), *words, *device, kept=True)
        if not is_newer(out / video, folder.checkpoint):
            show("Trained and measured; the video follows.", split)
            words = ["--minutes", f"{clock.left:.3g}"]
            step("render", str(folder), "--out", str(out / video), *words, *device)
        show("", split)
        clock.made_of = _mark(folder.checkpoint)
    print(
        f"wrote {page} in {clock.passed:.1f} minutes; `pp-cl view {pasted(folder)}` shows the exact"
        " model"
    )


class _Clock:
    """The time budget: the minutes asked for and those used, kept in a file with the page's title
    so that the same command can go on. The time of a step that failed does not count.

    asked, title: None keeps the stored value.
    """

    def __init__(self, file: Path, asked: float | None, title: str | None) -> None:
        from pp_cl.errors import name_of
        from pp_cl.scene import read_json

        known: dict[str, Any] = read_json(file) if file.exists() else {}
        self.minutes = asked or known.get("minutes", MINUTES)
        before = known.get("title")
        self.title = before or name_of(file.parent) if title is None else title
        self.is_renamed = before not in (None, self.title)
        self._file, self._passed = file, known.get("passed", 0.0)
        # minutes for which the training was planned, and its iterations if it was extended later
        self._planned = known.get("planned", self.minutes)
        self._iterations: int | None = known.get("iterations")
        self._until = max(self.minutes, known.get("until", 0.0))
        self.made_of = known.get("made_of")  # _mark() of the checkpoint of which all was made
        self._began = time.monotonic()

    def __enter__(self) -> "_Clock":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not issubclass(kind, (Stopped, KeyboardInterrupt)):
            self._began = time.monotonic()
        self.keep()

    def keep(self) -> None:
        """Store the minutes used so far."""
        from pp_cl.files import write_json

        self._passed, self._began = self.passed, time.monotonic()
        kept = {"title": self.title, "minutes": self.minutes, "passed": round(self._passed, 2)}
        kept |= {"planned": self._planned, "until": round(self._until, 2)}
        write_json(self._file, kept | {"iterations": self._iterations, "made_of": self.made_of})

    @property
    def passed(self) -> float:
        """Minutes since the beginning, without breaks between two commands."""
        return self._passed + (time.monotonic() - self._began) / 60

    @property
    def left(self) -> float:
        """Minutes left, at least a tenth of one."""
        return max(self._until - self.passed, 0.1)

    @property
    def told(self) -> str:
        """The minutes left, in words."""
        return f"{self.left:.1f} of {round(self._until, 1):g} minutes left"

    def tell_of_capture(self, source: str) -> None:
        """Print how the minutes are divided before the photographs are read."""
        capture = min(PER_PHOTOGRAPH * _photographs(source), self.minutes)
        print(
            f"{self.minutes:g} minutes: about {capture:.1f} for cameras and masks, a quarter of the"
            " rest for evaluation, splat and video, and what is left for the training",
            flush=True,
        )

    def training(self) -> float:
        """Plan the training: return its minutes, and print how the rest is divided."""
        passed = self.passed
        minutes_left = max(self.minutes - passed, LEAST_LEFT * self.minutes)
        self._planned, self._until = self.minutes, passed + minutes_left
        self._iterations = None
        return self._divided(minutes_left)

    def _divided(self, minutes):
        """Return and print the minutes of a training, out of those that are left."""
        after = min(max(AFTER * minutes, LEAST_AFTER), MOST_AFTER, (1 - LEAST_TRAINING) * minutes)
        text = f"{self.minutes:g} minutes: {self.passed:.1f} have passed"
        if self._until > self.minutes + 0.05:
            text += f", which is too long; {self._until:.1f} are taken in all"
        print(
            f"{text}; {minutes - after:.1f} for the training, {after:.1f} for evaluation, splat and"
            " video",
            flush=True,
        )
        return minutes - after

    def more(self, folder: "RunFolder") -> float:
        """The minutes in which a finished training goes on; 0 unless more minutes are asked for
        than it was planned for, and some are left.
        """
        minutes_left = self.minutes - self.passed
        if self._planned >= self.minutes or minutes_left < LEAST_MORE or len(folder.rows()) < 2:
            return 0.0
        self._planned, self._until = self.minutes, self.minutes
        self._iterations = None
        self.keep()
        return self._divided(minutes_left)

    def extended(self, folder: "RunFolder", minutes: float) -> list[str]:
        """The arguments of a finished training that goes on for these minutes."""
        rows = folder.rows()
        end = rows.pop()  # the training's last step is in the row before
        late = next((row for row in rows if row["step"] >= LATE * end["step"]), rows[0])
        took, last = rows[-1]["seconds"] - late["seconds"], rows[-1]
        seconds = took / max(last["step"] - late["step"], 1) or last["seconds"] / last["step"]
        ending = end["seconds"] - last["seconds"]
        self._iterations = end["step"] + max(1, round((60 * minutes - ending) / seconds))
        self.keep()
        return self.iterations()

    def iterations(self) -> list[str]:
        """The arguments of a training that goes on after it was finished."""
        return ["--iterations", str(self._iterations)] if self._iterations else []


def _wrote_hull(out, scene, title, options, masks):
    """Write the page of the hull that the masks give; return whether it could."""
    from pp_studio.export.hull import hull_gaussians
    from pp_studio.export.result import write_model

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the training gives the same warnings
        try:
            hull = hull_gaussians(scene, options.masks if masks else None, options.device)
        except UserError:
            return False
    if hull:
        write_model(out, *hull, title)
    return hull is not None


def _mark(checkpoint):
    """Text that tells a checkpoint from others: a digest of its file's end, which has the checksums
    of all its arrays.
    """
    with checkpoint.open("rb") as file:
        file.seek(-min(MARKED, file.seek(0, os.SEEK_END)), os.SEEK_END)
        return hashlib.sha256(file.read()).hexdigest()


def _written(scene):
    """When a capture wrote a scene; None if there is none."""
    file = Path(scene, "transforms.json")
    return file.stat().st_mtime_ns if file.exists() else None


def _set_aside(folder):
    """Rename a run, so that another takes its place; return its new path."""
    steps = max((row["step"] for row in folder.rows()), default=0)
    kept = folder.path.with_name(f"run-of-{steps}-steps")
    for number in itertools.count(2):
        if not kept.exists():
            return folder.path.rename(kept)
        kept = folder.path.with_name(f"run-of-{steps}-steps-{number}")


def _is_scene(source):
    """Whether `pp-cl train` can read the source; photographs have no poses yet."""
    from pp_cl.scene import scene_format

    if source != "demo" and not Path(source).exists():
        raise UserError(
            f"{source}: no such folder or video; give photographs, a video or a scene, or demo"
        )
    try:
        return bool(scene_format(source))
    except UserError:
        content = f"{_photographs(source)} photographs" if Path(source).is_dir() else "a video"
        print(f"{source}: {content}; working out where each was taken, and cutting out the object")
        return False


def _photographs(source):
    """How many photographs a capture uses."""
    from pp_studio.capture.frames import FRAMES, listed

    return len(listed(Path(source))) if Path(source).is_dir() else FRAMES


def _hints(options):
    """The arguments of a capture."""
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


def _step(name, *words, note, **more):
    """Run a command as if typed. note: printed beside it. more: keyword arguments of its run()."""
    print(f"== pp-cl {name} {shlex.join(words)}  # {note}", flush=True)
    module = importlib.import_module(COMMANDS[name])
    parser = argparse.ArgumentParser(prog=f"pp-cl {name}")
    module.add_arguments(parser)
    module.run(parser.parse_args(list(words)), **more)
