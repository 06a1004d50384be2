"""`pp-cl make`: from photographs, a video or a scene to a folder that can be sent."""

import argparse
import importlib
import shlex
from pathlib import Path

from pp_cl.commands import COMMANDS
from pp_cl.commands import options as shared
from pp_cl.config import field_of
from pp_cl.errors import UserError
from pp_studio.commands.capture import add_hints

HELP = "photos, a video or a scene to a page, a video and a splat, in one folder"
EPILOG = """FOLDER then holds
  index.html           the result: the model to turn, views beside their photographs, the figures
  model.html           the model alone, on one page
  video.mp4, splat.ply once around the object; 3D Gaussians for other viewers
  thumbnail.png        an image of it
  scene, run           what was captured of photographs; the training, which all other commands take
Its parts are capture, train, eval, render and export. The same command goes on where it stopped."""
MINUTES, MOST_MINUTES = 20.0, field_of("train.minutes").metadata["most"]
# the preset of so many minutes: on two cores with AVX-512 the steps of `small` take 7, of `full` 25
PRESET_FROM = {"full": 30.0, "small": 8.0, "tiny": 0.0}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("source", metavar="INPUT", help="folder of photographs, a video, a scene, or the word demo")
    add("--out", required=True, metavar="FOLDER", help="folder of the result")
    add(
        "--minutes",
        type=shared.number(0.1, MOST_MINUTES),
        metavar="N",
        help=f"minutes of training ({MINUTES:g}); finding cameras and masks and fitting the splat"
        " come on top",
    )
    add(
        "--preset",
        choices=list(PRESET_FROM)[::-1],
        help="of the training (by the minutes: tiny below 8, small below 30, so also without"
        " --minutes, then full)",
    )
    add_hints(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Do the steps that are left, and say what to open."""
    from pp_cl import RunFolder, load
    from pp_studio.export.result import INDEX, SPLAT, begin_result, write_result

    out, is_scene = Path(options.out), _is_scene(options.source)
    if is_scene:
        shared.refuse(options, ("turntable", "mask_command", "box"), "only of photographs")
    begin_result(out)
    device = ["--device", options.device] if options.device else []
    folder, scene, masks, told = RunFolder(out / "run"), options.source, [], []
    if is_scene:
        masks = ["--masks", options.masks] if options.masks else []
    else:
        scene = str(out / "scene")
        _step("capture", options.source, "--out", scene, *_hints(options))
        told = _captured(Path(scene))
    if not folder.config.exists():
        minutes = options.minutes or MINUTES
        chosen = next(name for name, least in PRESET_FROM.items() if minutes >= least)
        preset = ["--preset", options.preset or chosen, "--minutes", f"{minutes:g}"]
    else:  # as it began, unless told otherwise, which train refuses
        preset = ["--preset", options.preset] if options.preset else []
        preset += ["--minutes", f"{options.minutes:g}"] if options.minutes else []
    _step("train", scene, "--out", str(folder), *preset, *masks, *device)
    split = _held_out(scene)
    _step("eval", str(folder), "--split", split, *device)
    video = _video()
    for name, file, words in (("render", video, []), ("export", SPLAT, ["--format", "splat"])):
        if not _is_newer(out / file, folder.checkpoint):
            _step(name, str(folder), "--out", str(out / file), *words, *device)
    write_result(load(folder.path, options.device), split, out, video, told)
    print(f"wrote {out / INDEX}: open it in a browser; `pp-cl view {folder}` shows the exact model")


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
    for name in ("masks", "mask_command"):
        if getattr(options, name):
            words += [f"--{name.replace('_', '-')}", getattr(options, name)]
    if options.box:
        box = options.box if isinstance(options.box, str) else ",".join(map(repr, options.box))
        words.append(f"--box={box}")
    return words


def _captured(scene: Path) -> list[str]:
    """What the stages of a capture have found, but for what the last one has written."""
    from pp_cl.scene import read_json
    from pp_studio.capture import STAGES

    *stages, _ = STAGES
    return [f"{name}: {read_json(scene / 'capture' / f'{name}.json')['line']}" for name in stages]


def _video():
    """The name of the video: of a format that can be written here."""
    from pp_studio.export.result import VIDEOS
    from pp_studio.video import check_video

    try:
        check_video(VIDEOS[0].partition(".")[2])
    except UserError:
        return VIDEOS[1]
    return VIDEOS[0]


def _held_out(scene):
    """The split that is measured: train where no views are held out."""
    from pp_cl.scene import scene_splits

    return "test" if "test" in scene_splits(scene) else "train"


def _is_newer(file, other):
    """Whether a file is there, and was written after another one."""
    return file.exists() and file.stat().st_mtime_ns > other.stat().st_mtime_ns


def _step(name, *words):
    """Run another command, as it would be typed."""
    print(f"== pp-cl {name} {shlex.join(words)}", flush=True)
    module = importlib.import_module(COMMANDS[name])
    parser = argparse.ArgumentParser(prog=f"pp-cl {name}")
    module.add_arguments(parser)
    module.run(parser.parse_args(list(words)))
