"""`pp-cl render`: renders a run along a camera path, as a video or as frames."""

import argparse
import math
import mimetypes
import statistics
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "render a run along a path of cameras: a video, or frames with alpha and depth"
EPILOG = """paths:
  orbit       a circle around the object, at the height of the photographs
  spiral      two turns, from the lowest photographs to the highest; one where these form a ring
  SPLIT       the cameras of a split of the scene: train, val, test
  FILE        nerfstudio's camera_path.json, a transforms.json, or cameras.json of 3D Gaussian
              Splatting and brush, in the world of the scene"""
VIDEOS, IMAGES = ("mp4", "webm", "webp", "gif"), ("png", "exr")
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}
MADE = ("orbit", "spiral")  # paths that the program makes
SECONDS, FPS = 4, 30
FASTEST_GIF = 50  # frames per second; browsers show faster ones slowly
MOST_FRAMES = 100_000
# bounds of the height of an orbit or spiral; mp4 needs an even width and height
LEAST_HEIGHT, MOST_HEIGHT = 480, 1080


def _colour(text):
    """Convert --background: a key of COLOURS, or sRGB in [0, 1]."""
    if text in COLOURS:
        return text
    try:
        red, green, blue = map(shared.integer(0, 255), text.split(","))
    except (ValueError, UserError):
        raise UserError(f"{text}: write white, black, transparent or R,G,B from 0 to 255") from None
    return red / 255, green / 255, blue / 255


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folder", metavar="RUN", help="folder of the run")
    add("--path", default="orbit", metavar="P", help="orbit (default), spiral, SPLIT or FILE")
    add(
        "--out",
        metavar="NAME",
        help="a video (.mp4, .webm, .webp, .gif), else a folder for frames (default: in RUN/render,"
        " named after path and size)",
    )
    add(
        "--format",
        choices=(*VIDEOS, *IMAGES),
        help="a video (mp4, webm, webp, gif) or frames (png, exr); by --out, else mp4",
    )
    add(
        "--size",
        type=shared.size,
        metavar="WxH",
        help="pixels (default: those of the training; an orbit or spiral is"
        f" {LEAST_HEIGHT} to {MOST_HEIGHT} high)",
    )
    add(
        "--fov",
        type=shared.number(1, 150),
        metavar="DEGREES",
        help="horizontal angle of view (default: the scene's)",
    )
    add(
        "--seconds",
        type=shared.number(1e-3, 1e5),
        metavar="S",
        help=f"length of an orbit or spiral ({SECONDS})",
    )
    add(
        "--fps",
        type=shared.number(0.1, 240),
        metavar="F",
        help=f"frames per second ({FPS}, or what a camera_path.json states)",
    )
    add(
        "--background",
        type=_colour,
        metavar="B",
        help="white (default), black, transparent or R,G,B from 0 to 255",
    )
    add(
        "--samples",
        type=int,
        choices=(1, 4, 9, 16),
        default=1,
        metavar="N",
        help="samples per pixel: 1, 4, 9 or 16",
    )
    add(
        "--minutes",
        type=shared.number(0.01, 1e5),
        default=math.inf,
        metavar="N",
        help="draw less finely, or the 3D Gaussians that an export has fitted, where all frames"
        " would take longer",
    )
    add("--features", action="store_true", help="exr: also the 16 features of each pixel")
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Render the frames that are missing, and make a video of them if one is asked for."""
    from pp_cl import load
    from pp_cl.files import own
    from pp_cl.scene import read_rate
    from pp_studio.export.render_video import render_frames, render_video
    from pp_studio.video import check_video

    kind = _format(options)
    stated = read_rate(Path(options.path)) if Path(options.path).suffix else None
    options.fps = options.fps or stated or FPS
    style, count = _style(options, kind), _frame_count(options, kind)
    if kind in VIDEOS:
        check_video(kind)
    run = load(options.run_folder, options.device, scene=options.scene)
    cameras = _cameras(run, options.path, count, size=options.size, fov=options.fov)
    sizes = {(camera.width, camera.height) for camera in cameras}
    if kind in VIDEOS and len(sizes) > 1:
        raise UserError(
            f"--path {options.path}: its images differ in size, which no video does; give --size"
            " WxH, or --format png"
        )
    out = Path(options.out) if options.out else _default(run, options.path, sizes, kind)
    if kind in VIDEOS and not options.out:
        own(out.parent, [out], "move it away, or choose another --out")
    if kind in VIDEOS:
        rendered = render_video(run, cameras, out, options.fps, style, minutes=options.minutes)
    else:
        rendered = render_frames(run, cameras, out, style, minutes=options.minutes)
    made = f"{len(rendered.seconds)} of {len(cameras)} frames"
    if rendered.seconds:
        made += f", {statistics.median(rendered.seconds) * 1e3:.0f} ms each on {run.dev.name}"
    if rendered.why:
        print(f"frames are {rendered.why}")
    print(f"rendered {made}\nwrote {out}")


def _format(options):
    """One of VIDEOS or IMAGES, according to --out and --format."""
    suffix = Path(options.out).suffix[1:].lower() if options.out else ""
    if suffix in VIDEOS and options.format not in (None, suffix):
        raise UserError(
            f"--out {options.out}: is a video by its name, --format {options.format} is another;"
            " leave one of them out"
        )
    if options.out and suffix not in VIDEOS and options.format in VIDEOS:
        raise UserError(
            f"--out {options.out}: --format {options.format} is a video; name it"
            f" {options.out}.{options.format}"
        )
    if suffix in VIDEOS or not options.out:
        return suffix or options.format or VIDEOS[0]
    if (mimetypes.guess_type(options.out)[0] or "").startswith(("video/", "image/")):
        raise UserError(
            f"--out {options.out}: videos end in .mp4, .webm, .webp or .gif, frames go into a"
            " folder; name one of these"
        )
    return options.format or IMAGES[0]


def _default(run, path, sizes, kind):
    """Where to write without --out. sizes: {(width, height)} of the path's images."""
    name = Path(path).stem if Path(path).suffix else path
    name += "_{}x{}".format(*sizes.pop()) if len(sizes) == 1 else ""
    return run.folder.path / "render" / (f"{name}.{kind}" if kind in VIDEOS else name)


def _style(options, kind):
    """The render_video.Style that the options describe."""
    from pp_studio.export.render_video import Style

    if options.background and kind == "exr":
        raise UserError("--background: OpenEXR keeps alpha in its place; leave it out")
    background = COLOURS.get(options.background or "white", options.background)
    if background is None and kind == "mp4":
        raise UserError("--background transparent: mp4 keeps no alpha; write .webm or frames")
    if options.features and kind != "exr":
        raise UserError("--features: only OpenEXR has room for them; use --format exr")
    return Style("exr" if kind == "exr" else "png", background, options.samples, options.features)


def _frame_count(options, kind):
    """The number of frames of an orbit or spiral; 0 for other paths."""
    fps, seconds = options.fps, options.seconds
    if kind == "gif" and fps > FASTEST_GIF:
        raise UserError(f"--fps {fps:g}: a gif has at most {FASTEST_GIF} frames per second")
    if options.path not in MADE:
        if seconds is not None:
            raise UserError(
                f"--seconds {seconds:g}: only an orbit or spiral has as many frames as asked for;"
                " leave it out"
            )
        return 0
    seconds = seconds or SECONDS
    count = round(seconds * fps)
    if not 1 <= count <= MOST_FRAMES:
        raise UserError(
            f"--seconds {seconds:g}: {seconds * fps:g} frames at {fps:g} a second; ask for 1 to"
            f" {MOST_FRAMES}"
        )
    return count


def _cameras(run, path, count, *, size, fov):
    """The cameras of a path in a size and angle of view; `count` for an orbit or spiral."""
    from pp_cl.scene import read_cameras
    from pp_studio.camera_path import around

    def shaped(camera):
        camera = camera.resized(*size) if size else camera
        return camera.with_angle(math.radians(fov)) if fov else camera

    if Path(path).suffix:
        return [shaped(camera) for camera in read_cameras(Path(path), size)]
    if path not in MADE:
        try:
            return [shaped(camera) for camera in run.cameras(path)]
        except UserError as error:
            raise UserError(
                f"--path {path}: {error}; the paths that every run has are orbit and spiral"
            ) from None
    training = run.cameras("train")
    first = shaped(training[0])
    if not size:
        height = 2 * round(min(max(first.height, LEAST_HEIGHT), MOST_HEIGHT) / 2)
        first = first.resized(2 * round(first.width / first.height * height / 2), height)
    return around(path, training, run.model.positions(), first, count)
