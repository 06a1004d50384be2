"""Videos from frames: MP4 and WebM with the ffmpeg of imageio's wheel, GIF and WebP with Pillow."""

from collections.abc import Iterable
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from pp_cl.errors import UserError, require
from pp_cl.files import atomic_path

LOOPED = ("gif", "webp")  # formats that pages show without a player
FORMATS = ("mp4", "webm", *LOOPED)
MOST_FRAMES = 100_000  # most frames of a video for a page
# players guess BT.601 or BT.709 from the size of untagged videos; sRGB has BT.709's primaries
CONVERTED = "scale=out_color_matrix=bt709:out_range=tv"
TAGGED = "setparams=color_primaries=bt709:color_trc=bt709:colorspace=bt709:range=tv"
COLOURS = ["-vf", f"{CONVERTED},{TAGGED}"]
AT_ONCE = ["-movflags", "+faststart"]  # index first: browsers play the video as it arrives


def check_video(suffix: str) -> None:
    """Raise UserError, with the remedy, if a video of this format cannot be made."""
    if suffix in LOOPED:
        return
    require("a video, unlike --format webp or frames,", "imageio", "imageio-ffmpeg")
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"imageio-ffmpeg: {error}; write --format webp or png") from None


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write a video in the format of the path's suffix, one of FORMATS. frames: uint8, all of one
    size, (H, W, 3), or (H, W, 4) with straight alpha, which WebM keeps. An odd side is extended by
    its last row or column. Raises UserError naming the file if it cannot be written.
    """
    path = path.resolve()  # ffmpeg takes 12:30.mp4 for an address
    frames = (np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), "edge") for f in frames)
    looped = path.suffix.lower()[1:] in LOOPED
    with atomic_path(path) as temporary:
        (_write_looped if looped else _write)(temporary, frames, fps)


def _write_looped(path, frames, fps):
    images = map(Image.fromarray, frames)
    # durations in whole units; their sum is off by less than one unit wherever the video ends
    unit = 10 if path.suffix.lower() == ".gif" else 1
    ends = [round(i * 1000 / fps / unit) for i in range(MOST_FRAMES + 1)]
    durations = [unit * (end - start) for start, end in pairwise(ends)]
    first, options = next(images), {"save_all": True, "duration": durations, "loop": 0}
    if path.suffix.lower() == ".gif" and first.mode == "RGBA":
        options["disposal"] = 2  # else earlier frames stay where this one is transparent
    first.save(path, append_images=images, **options)


def _write(path, frames, fps):
    """Raises OSError if the video is incomplete: imageio does not report a full disk."""
    import imageio.v2 as imageio
    from imageio_ffmpeg import count_frames_and_secs

    first, written = next(frames), 0
    if path.suffix.lower() == ".mp4":
        options = {"codec": "libx264", "quality": 8, "pixelformat": "yuv420p"}
        options["output_params"] = [*COLOURS, *AT_ONCE]
    else:
        pixels = "yuva420p" if first.shape[2] == 4 else "yuv420p"
        options = {"codec": "libvpx-vp9", "quality": None, "pixelformat": pixels}
        quality = ["-crf", "24", "-b:v", "0", "-auto-alt-ref", "0"]
        options["output_params"] = [*quality, *COLOURS]
    # on a full disk, ffmpeg would print four lines
    options |= {"fps": fps, "macro_block_size": 1, "ffmpeg_log_level": "quiet"}
    options["input_params"] = ["-threads", "2"]
    with imageio.get_writer(str(path), **options) as writer:
        for frame in chain([first], frames):
            writer.append_data(frame)
            written += 1
    try:
        there = count_frames_and_secs(path)[0]
    except RuntimeError:
        there = 0
    if there != written:
        raise OSError(f"{there} of its {written} frames were kept")
