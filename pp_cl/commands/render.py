"""The command pp-cl render."""

import argparse
import math
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "render a run along a path of cameras: a film, or images with alpha and depth"
EPILOG = """paths:
  orbit       a circle around the object, at the height of the photographs
  spiral      two turns, from the lowest photographs to the highest
  SPLIT       the cameras of a split of the scene: train, val, test
  FILE        nerfstudio's camera_path.json, a transforms.json, or cameras.json of 3D Gaussian
              Splatting and brush, in the world of the scene"""
FILMS, IMAGES = ("mp4", "webm", "gif"), ("png", "exr")
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}
MOST_SIDE, MOST_FRAMES = 8192, 100_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folder", metavar="RUN", help="folder of the run")
    add("--path", default="orbit", metavar="P", help="orbit (default), spiral, SPLIT or FILE")
    add("--out", metavar="FOLDER", help="of the frames (default: RUN/render/PATH)")
    add(
        "--format",
        choices=(*FILMS, *IMAGES),
        default="mp4",
        help="a film (mp4, webm, gif) beside its PNG frames, or frames alone (png, exr)",
    )
    add("--size", metavar="WxH", help="pixels (default: those of the training)")
    add("--fov", metavar="DEGREES", help="angle of view across the image (default: the scene's)")
    add("--seconds", default="4", metavar="S", help="of an orbit or spiral (4)")
    add("--fps", default="30", metavar="F", help="frames per second (30)")
    add(
        "--background",
        default="white",
        metavar="B",
        help="white (default), black, transparent or R,G,B from 0 to 255",
    )
    add("--samples", default="1", metavar="N", help="per pixel: 1, 4, 9 or 16")
    add("--features", action="store_true", help="in exr: the 16 features of each pixel too")
    add("--scene", metavar="SCENE", help="where the run's scene is now, if it has moved")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Render the frames that are missing, then write film and contact sheet."""
    from pp_cl.device.discover import open_device
    from pp_cl.files.video import check_video
    from pp_cl.film import Frames
    from pp_cl.trained import load_run

    style, size, fov = _style(options), _size(options), _fov(options)
    fps, count = _speed(options)
    if options.format in FILMS:
        check_video(options.format)
    run = load_run(open_device(options.device), options.run_folder, scene=options.scene)
    cameras = _cameras(run, options.path, count, size=size, fov=fov)
    if options.format in FILMS and len({(c.width, c.height) for c in cameras}) > 1:
        raise UserError(
            f"--path {options.path}: its images differ in size, which no film does; give --size"
            " WxH, or --format png"
        )
    out = Path(options.out) if options.out else run.folder.path / "render" / _name(options.path)
    frames = Frames(run, cameras, out, style)
    seconds = _render_with_bar(frames)
    made = f"{len(seconds)} of {len(cameras)} frames"
    if seconds:
        made += f", {sorted(seconds)[len(seconds) // 2] * 1e3:.0f} ms each on {run.dev.name}"
    sheet = out.with_name(f"{out.name}.png")
    frames.write_sheet(sheet)
    written = [str(out), str(sheet)]
    if options.format in FILMS:
        film = out.with_name(f"{out.name}.{options.format}")
        frames.write_film(film, fps)
        written.insert(0, str(film))
    print(f"rendered {made}")
    print(f"wrote {', '.join(written)}")


def _style(options):
    """film.Style of the options."""
    from pp_cl.film import Style

    samples = shared.read_number("--samples", options.samples, int, least=1, most=16)
    if math.isqrt(samples) ** 2 != samples:
        raise UserError(f"--samples {options.samples}: write 1, 4, 9 or 16")
    background = _background(options.background)
    if background is None and options.format == "mp4":
        raise UserError("--background transparent: mp4 keeps no alpha; use --format webm or png")
    if options.features and options.format != "exr":
        raise UserError("--features: only OpenEXR has room for them; use --format exr")
    suffix = "exr" if options.format == "exr" else "png"
    return Style(suffix, background, samples, options.features)


def _background(text):
    """sRGB in [0, 1], or None for transparent."""
    if text in COLOURS:
        return COLOURS[text]
    words = text.split(",")
    if len(words) != 3 or not all(0 <= shared.whole(w) <= 255 for w in words):
        raise UserError(
            f"--background {text}: write white, black, transparent or R,G,B from 0 to 255"
        )
    return tuple(int(w) / 255 for w in words)


def _speed(options):
    """(frames per second, frames of an orbit or spiral) of the options."""
    fps = shared.read_number("--fps", options.fps, float, least=0.1, most=240)
    seconds = shared.read_number("--seconds", options.seconds, float, least=1e-3, most=1e5)
    count = round(seconds * fps)
    if not 1 <= count <= MOST_FRAMES:
        raise UserError(
            f"--seconds {options.seconds}: {seconds * fps:g} frames at {fps:g} a second; ask for 1"
            f" to {MOST_FRAMES}"
        )
    return fps, count


def _size(options):
    """(width, height) of --size, None where it is not given."""
    if options.size is None:
        return None
    words = options.size.lower().split("x")
    if len(words) != 2 or not all(16 <= shared.whole(w) <= MOST_SIDE for w in words):
        raise UserError(f"--size {options.size}: write WIDTHxHEIGHT, each from 16 to {MOST_SIDE}")
    return int(words[0]), int(words[1])


def _fov(options):
    """Radians of --fov, None where it is not given."""
    if options.fov is None:
        return None
    return math.radians(shared.read_number("--fov", options.fov, float, least=1, most=150))


def _name(path):
    """What frames of a path are called."""
    return Path(path).stem if Path(path).suffix else path


def _cameras(run, path, count, *, size, fov):
    """The cameras of a path, `count` of an orbit or spiral, with size and angle of view."""
    from pp_cl.scene.camera_path import Surroundings
    from pp_cl.scene.readers.camera_file import read_cameras

    def shaped(camera):
        camera = camera.resized(*size) if size else camera
        return camera.with_angle(fov) if fov else camera

    if Path(path).suffix:
        return [shaped(camera) for camera in read_cameras(Path(path), size)]
    if path not in ("orbit", "spiral"):
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
