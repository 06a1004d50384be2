"""The command pp-cl render."""

import argparse
import math
import mimetypes
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "render a run along a path of cameras: a film, or frames with alpha and depth"
EPILOG = """paths:
  orbit       a circle around the object, at the height of the photographs
  spiral      two turns, from the lowest photographs to the highest
  SPLIT       the cameras of a split of the scene: train, val, test
  FILE        nerfstudio's camera_path.json, a transforms.json, or cameras.json of 3D Gaussian
              Splatting and brush, in the world of the scene"""
FILMS, IMAGES = ("mp4", "webm", "gif"), ("png", "exr")
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}
MADE = ("orbit", "spiral")  # paths that the program makes
SECONDS, FPS = 4, 30
FASTEST_GIF = 50  # frames per second; browsers show faster ones slowly
MOST_SIDE, MOST_FRAMES = 8192, 100_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folder", metavar="RUN", help="folder of the run")
    add("--path", default="orbit", metavar="P", help="orbit (default), spiral, SPLIT or FILE")
    add(
        "--out",
        metavar="NAME",
        help="a film, by its suffix .mp4, .webm or .gif, else a folder for frames (default: in"
        " RUN/render, named after path and size)",
    )
    add(
        "--format",
        choices=(*FILMS, *IMAGES),
        help="a film (mp4, webm, gif) or frames (png, exr); by --out, else mp4",
    )
    add("--size", metavar="WxH", help="pixels (default: those of the training)")
    add("--fov", metavar="DEGREES", help="angle of view across the image (default: the scene's)")
    add("--seconds", metavar="S", help=f"of an orbit or spiral ({SECONDS})")
    add("--fps", metavar="F", help=f"frames per second ({FPS})")
    add(
        "--background",
        metavar="B",
        help="white (default), black, transparent or R,G,B from 0 to 255",
    )
    add("--samples", default="1", metavar="N", help="per pixel: 1, 4, 9 or 16")
    add("--features", action="store_true", help="in exr: the 16 features of each pixel too")
    add("--scene", metavar="SCENE", help="where the run's scene is now, if it has moved")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Render the frames that are missing, and make a film of them where one is asked for."""
    from pp_cl.device.discover import open_device
    from pp_cl.files.video import check_video
    from pp_cl.film import Frames, film_folder
    from pp_cl.trained import load_run

    shared.refuse_empty(options)
    kind = _format(options)
    style, size, fov = _style(options, kind), _size(options), _fov(options)
    fps, count = _speed(options, kind)
    if kind in FILMS:
        check_video(kind)
    run = load_run(open_device(options.device), options.run_folder, scene=options.scene)
    cameras = _cameras(run, options.path, count, size=size, fov=fov)
    sizes = {(camera.width, camera.height) for camera in cameras}
    if kind in FILMS and len(sizes) > 1:
        raise UserError(
            f"--path {options.path}: its images differ in size, which no film does; give --size"
            " WxH, or --format png"
        )
    out = Path(options.out) if options.out else _default(run, options.path, sizes, kind)
    if kind in FILMS:
        with film_folder(out) as folder:
            frames = Frames(run, cameras, folder, style, replace=True)
            seconds = _render_with_bar(frames)
            frames.write_film(out, fps)
    else:
        seconds = _render_with_bar(Frames(run, cameras, out, style))
    made = f"{len(seconds)} of {len(cameras)} frames"
    if seconds:
        made += f", {sorted(seconds)[len(seconds) // 2] * 1e3:.0f} ms each on {run.dev.name}"
    print(f"rendered {made}")
    print(f"wrote {out}")


def _format(options):
    """Of FILMS or IMAGES, as the name of --out and --format say."""
    suffix = Path(options.out).suffix[1:].lower() if options.out else ""
    if suffix in FILMS and options.format not in (None, suffix):
        raise UserError(
            f"--out {options.out}: is a film by its name, --format {options.format} is another;"
            " leave one of them out"
        )
    if options.out and suffix not in FILMS and options.format in FILMS:
        raise UserError(
            f"--out {options.out}: --format {options.format} is a film; name it"
            f" {options.out}.{options.format}"
        )
    if suffix in FILMS or not options.out:
        return suffix or options.format or FILMS[0]
    if (mimetypes.guess_type(options.out)[0] or "").startswith(("video/", "image/")):
        raise UserError(
            f"--out {options.out}: films end in .mp4, .webm or .gif, frames go into a folder; name"
            " one of these"
        )
    return options.format or IMAGES[0]


def _default(run, path, sizes, kind):
    """Where a path is written that has no --out. sizes: {(width, height)} of its images."""
    name = Path(path).stem if Path(path).suffix else path
    name += "_{}x{}".format(*sizes.pop()) if len(sizes) == 1 else ""
    return run.folder.path / "render" / (f"{name}.{kind}" if kind in FILMS else name)


def _style(options, kind):
    """film.Style of the options."""
    from pp_cl.film import Style

    samples = shared.read_number("--samples", options.samples, int, least=1, most=16)
    if math.isqrt(samples) ** 2 != samples:
        raise UserError(f"--samples {options.samples}: write 1, 4, 9 or 16")
    if options.background and kind == "exr":
        raise UserError("--background: OpenEXR keeps alpha in its place; leave it out")
    background = _background(options.background or "white")
    if background is None and kind == "mp4":
        raise UserError("--background transparent: mp4 keeps no alpha; write .webm or frames")
    if options.features and kind != "exr":
        raise UserError("--features: only OpenEXR has room for them; use --format exr")
    return Style("exr" if kind == "exr" else "png", background, samples, options.features)


def _background(text):
    """sRGB in [0, 1], or None for transparent."""
    if text in COLOURS:
        return COLOURS[text]
    words = text.split(",")
    if len(words) != 3 or not all(_is_whole(w, 0, 255) for w in words):
        raise UserError(
            f"--background {text}: write white, black, transparent or R,G,B from 0 to 255"
        )
    return tuple(int(w) / 255 for w in words)


def _speed(options, kind):
    """(frames per second, frames of an orbit or spiral, 0 of other paths) of the options."""
    most = FASTEST_GIF if kind == "gif" else 240
    fps = shared.read_number("--fps", options.fps or str(FPS), float, least=0.1, most=most)
    if options.path not in MADE:
        if options.seconds is not None:
            raise UserError(
                f"--seconds {options.seconds}: only an orbit or spiral has as many frames as asked"
                " for; leave it out"
            )
        return fps, 0
    text = options.seconds or str(SECONDS)
    seconds = shared.read_number("--seconds", text, float, least=1e-3, most=1e5)
    count = round(seconds * fps)
    if not 1 <= count <= MOST_FRAMES:
        raise UserError(
            f"--seconds {text}: {seconds * fps:g} frames at {fps:g} a second; ask for 1 to"
            f" {MOST_FRAMES}"
        )
    return fps, count


def _size(options):
    """(width, height) of --size, None where it is not given."""
    if options.size is None:
        return None
    words = options.size.lower().split("x")
    if len(words) != 2 or not all(_is_whole(w, 16, MOST_SIDE) for w in words):
        raise UserError(f"--size {options.size}: write WIDTHxHEIGHT, each from 16 to {MOST_SIDE}")
    return int(words[0]), int(words[1])


def _is_whole(word, least, most):
    """Whether a word of digits is a number in [least, most]."""
    return word.isascii() and word.isdigit() and len(word) < 9 and least <= int(word) <= most


def _fov(options):
    """Radians of --fov, None where it is not given."""
    if options.fov is None:
        return None
    return math.radians(shared.read_number("--fov", options.fov, float, least=1, most=150))


def _cameras(run, path, count, *, size, fov):
    """The cameras of a path, `count` of an orbit or spiral, with size and angle of view."""
    from pp_cl.scene.camera_path import Surroundings
    from pp_cl.scene.readers.camera_file import read_cameras

    def shaped(camera):
        camera = camera.resized(*size) if size else camera
        return camera.with_angle(fov) if fov else camera

    if Path(path).suffix:
        return [shaped(camera) for camera in read_cameras(Path(path), size)]
    if path not in MADE:
        return [shaped(camera) for camera in run.cameras(path)]
    photographs = run.cameras("train")
    around, first = Surroundings(photographs, run.model.positions()), shaped(photographs[0])
    make = around.orbit if path == "orbit" else around.spiral
    return make(first, count)


def _render_with_bar(frames):
    """Seconds of each frame that was rendered, under a progress bar on a terminal."""
    from tqdm import tqdm

    seconds = []
    with tqdm(total=len(frames.paths), unit="frame", disable=None) as bar:

        def on_frame(took):
            bar.update()
            if took is not None:
                seconds.append(took)

        frames.render(on_frame)
    return seconds
