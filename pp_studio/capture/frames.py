"""Makes the images of a scene: upright copies of photographs, or the sharpest frames of a video,
without blurred, broken and repeated ones; later removes their lens distortion.
"""

import logging
import math
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from pp_cl import track
from pp_cl.engine import Device
from pp_cl.errors import UserError, shown
from pp_cl.files import (
    atomic_file,
    atomic_folder,
    in_srgb,
    is_deep_png,
    is_owned,
    opened_regular,
    read_rgba,
    write_png,
)
from pp_cl.scene import MASK_FOLDERS, ImageFile, undistort
from pp_studio.capture.packages import needed
from pp_studio.capture.uniform import is_uniform

ENDINGS = (
    *(".jpg", ".jpeg", ".jfif", ".png", ".webp", ".tif", ".tiff", ".bmp"),
    *(".avif", ".heic", ".heif"),
)
# Pillow's names of the formats; JPEG also opens the MPO of phones
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF", "HEIF")
COPIED = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}  # formats that are copied as they are
MAKE, MODEL, EXIF = 0x010F, 0x0110, 0x8769
# tags in the part of EXIF about the exposure; phones crop and enlarge, and may state only ZOOM
FOCAL, FOCAL_35, ZOOM = 0x920A, 0xA405, 0xA404
# tags there, too: pixels across and down, pixels per unit, the unit
SENSOR = (0xA002, 0xA003, 0xA20E, 0xA210)
PER_MM = {2: 25.4, 3: 10.0, 4: 1.0}  # millimetres in a unit
REDUCED = 0.01  # relative difference from EXIF's size that shows a reduced photograph
POSSIBLE = 0.2, 20.0  # focal lengths, in longer sides of the image
QUALITY = {"quality": 95, "subsampling": 0}  # of JPEGs
LEAST = 8  # photographs
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef")  # of cameras
OTHERS = (".jxl", ".jp2", ".j2k", ".psd", ".exr", ".hdr", ".insp")  # pictures that are not read
DIGITS = 6  # to which numbers in names are padded, so that 10 follows 9
SEEN, SMALL = 640, 64  # longer side, pixels, at which sharpness and likeness are measured
BLURRED = 0.2  # share of the neighbours' median sharpness below which an image is blurred
EMPTY = 1.0  # sharpness, levels squared; noise alone has more
NEIGHBOURS = 10  # on either side
ALIKE = 0.15  # share of the neighbours' usual difference below which images are alike
SAME = 0.3  # levels of 255: small copies of the same photograph differ by less
DECODED, MOST_DECODED = 18, 3 * 2**28  # bytes to decode a pixel, and for all decoding at once
FRAMES, GROUP = 120, 12  # frames taken from a video; frames in a group of the filter
WHOLE_SHARE = 0.9  # of the frames that a video states, or it was cut off
LOCAL = ["-protocol_whitelist", "file,pipe"]  # so that a video cannot name another machine
EACH_ONCE = ["-fps_mode", "passthrough"]
# Interlaced frames, which many videos do not declare, are recognised by their content and lose the
# lines of one moment; pixels become square, whatever shape the video states.
WHOLE = "idet,yadif=deint=interlaced"
SQUARE = "scale=w='iw*max(sar,1)':h='ih*max(1/sar,1)',setsar=1"
HDR = ("arib-std-b67", "smpte2084")  # transfer functions of phones: HLG and PQ
WHITE = 203  # candela per square metre: BT.2408's diffuse white
# to sRGB: light above 0.7 of white is compressed; HLG and PQ imply BT.2020, even if not tagged
TONE_MAPPED = (
    f",setparams=color_primaries=bt2020:colorspace=bt2020nc,zscale=t=linear:npl={WHITE}"
    ",format=gbrpf32le,zscale=p=bt709,tonemap=mobius:param=0.7:desat=0"
    ",zscale=t=iec61966-2-1:m=gbr:r=full"
)


def take_images(source: Path, images: Path) -> dict[str, Any]:
    """Write the photographs of a folder, or the sharpest frame of each of FRAMES intervals of a
    video, to the new folder `images`, upright, as JPEG or PNG.

    Returns {"images": [{name, source, lens, focal, size, sharpness, uniform}], "left_out":
    [{source, reason}]}; lens is equal for photographs of one camera at one focal length; focal, in
    pixels, is None if COLMAP guesses it from EXIF; uniform: whether the background is. Raises
    UserError if too few images are usable.
    """
    with atomic_folder(images) as unfinished:
        take = _photographs if source.is_dir() else _frames
        taken = list(take(source, unfinished))
        _leave_out(taken)
        usable = [image for image in taken if "reason" not in image]
        left_out = [image for image in taken if "reason" in image]
        for image in left_out:
            if "name" in image:
                (unfinished / image["name"]).unlink()
        if len(usable) < LEAST:
            why = [f"{image['source']} {image['reason']}" for image in left_out[:3]]
            others = f", {len(left_out)} cannot be used ({'; '.join(why)})" if why else ""
            raise UserError(
                f"{source}: {len(usable)} images{others}; at least {LEAST} are needed: take 30 or"
                " more all around the object"
            )
    for image in usable:
        del image["small"]
    reasons = [{key: image[key] for key in ("source", "reason")} for image in left_out]
    return {"images": usable, "left_out": reasons}


def _photographs(folder, images):
    """Yield the facts of each photograph, raw ones too; write readable ones to `images`."""
    needed("pillow_heif").register_heif_opener()
    files, unread = listed(folder), listed(folder, _is_unread)
    if not files:
        kinds = ", ".join(sorted({file.suffix.lower() for file in unread}))
        why = f", and {kinds} are not read: write JPEGs of them" if unread else ""
        raise UserError(
            f"{folder}: no photographs in it ({', '.join(ENDINGS)}){why}; give the folder that has"
            " them, or a video"
        )
    stems = [file.relative_to(folder).with_suffix("").as_posix() for file in files]
    if sorted(stems) != stems:  # 10 after 9: matching takes neighbours by name
        stems = [re.sub(r"\d+", lambda digits: digits[0].zfill(DIGITS), stem) for stem in stems]
    targets, taken = [], set()
    for stem in stems:
        # COLMAP's lists of pairs allow no spaces, and take lines that begin with # for comments;
        # its names are UTF-8, and Python keeps other bytes as surrogates
        name = re.sub(r"[\s\udc80-\udcff]+|^#|/", "_", stem)
        while name.lower() in taken:
            name += "_"
        taken.add(name.lower())
        targets.append(images / name)
    with ThreadPoolExecutor(_threads(max(_pixels(file) or 1 for file in files))) as pool:
        made = pool.map(lambda file, target: _take(folder, file, target), files, targets)
        yield from track(made, "frames", "image", len(files))
    for file in unread:
        what = "is raw" if file.suffix.lower() in RAW else "is of a kind that is not read"
        reason = f"{what} ({file.suffix}): write JPEGs of it"
        yield {"source": file.relative_to(folder).as_posix(), "reason": reason}


def _is_photograph(file):
    """Whether a file's name or its first bytes are a photograph's."""
    if file.suffix.lower() in ENDINGS:
        return True
    if _is_unread(file):  # raw photographs begin as TIFF does
        return False
    needed("pillow_heif").register_heif_opener()
    return _pixels(file) is not None


def _is_unread(file):
    """Whether a file's name is that of a picture that is not read."""
    return file.suffix.lower() in (*RAW, *OTHERS)


def listed(folder: Path, is_listed: Callable[[Path], bool] = _is_photograph) -> list[Path]:
    """The photographs in a folder and its subfolders, by their names or contents, in the order of
    their names, 10 after 9. Hidden files are left out, and so are folders of masks and folders that
    pp-cl fills. is_listed: lists other files.
    """
    paths = []
    for place, folders, files in os.walk(folder):
        here = Path(place)
        if here != folder and is_owned(here):
            folders.clear()
            continue
        folders[:] = [f for f in folders if not f.startswith(".") and f.lower() not in MASK_FOLDERS]
        paths += [here / f for f in files if f[0] != "." and is_listed(here / f)]

    def natural(file):
        name = file.relative_to(folder).as_posix()
        parts = re.split(r"(\d+)", name)
        return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)], name

    return sorted(paths, key=natural)


def _pixels(file):
    """The pixels of an image, by its header; None if it cannot be read."""
    try:
        with opened_regular(file) as opened:
            return math.prod(Image.open(opened, formats=FORMATS).size)
    except Exception:  # decoders raise all kinds of exceptions on broken bytes
        return None


def _threads(most):
    """How many images of at most these pixels are decoded at once."""
    return max(1, min(os.cpu_count() or 1, MOST_DECODED // (DECODED * most)))


def _take(folder, file, target):
    """The facts of a photograph, which is written to target with a suffix."""
    source = file.relative_to(folder)
    facts = {"source": source.as_posix()}
    try:
        with opened_regular(file) as opened:
            image = Image.open(opened, formats=FORMATS)
            image.load()
            turned, tags = ImageOps.exif_transpose(image), image.getexif()
            upright = in_srgb(file, turned)
            is_copied = (
                image.format in COPIED
                and upright is turned
                and image.mode in ("RGB", "RGBA", "L")
                and tags.get(ExifTags.Base.Orientation, 1) == 1
                and not is_deep_png(file)
            )
            content = opened.seek(0) or opened.read() if is_copied else None
            lens, exif = _lens(tags)
            # each folder has the photographs of one round, or of one camera
            facts["lens"] = f"{source.parent.as_posix()}: {lens}" if len(source.parts) > 1 else lens
            facts["focal"] = _focal_of_larger(tags.get_ifd(EXIF), image.size)
    except Image.DecompressionBombError:
        return facts | {"reason": "has more than 178 million pixels"}
    except UnidentifiedImageError:
        return facts | {"reason": f"is no image of a known kind ({', '.join(FORMATS)})"}
    except Exception as error:  # decoders raise all kinds of exceptions on broken bytes
        return facts | {"reason": f"cannot be read ({shown(str(error), 80)})"}
    alpha = upright.convert("RGBA").getchannel("A") if upright.has_transparency_data else None
    has_alpha = alpha is not None and alpha.getextrema()[0] < 255
    facts |= _look(upright) | {"uniform": not has_alpha and _is_uniform(upright)}
    suffix = COPIED[image.format] if is_copied else ".png" if has_alpha else ".jpg"
    facts["name"] = target.name + suffix
    with atomic_file(target.with_name(facts["name"])) as copy:
        if is_copied:
            copy.write(content)
        elif has_alpha:
            upright.convert("RGBA").save(copy, "PNG")
        else:
            upright.convert("RGB").save(copy, "JPEG", exif=exif, **QUALITY)
    return facts


def _lens(exif):
    """(text that tells cameras and focal lengths apart, EXIF for COLMAP's guess of a length)."""
    exposure, copied = exif.get_ifd(EXIF), Image.Exif()
    # the other tags may be broken, or too long for a JPEG
    copied.update({tag: exif[tag] for tag in (MAKE, MODEL) if tag in exif})
    wanted = (FOCAL, FOCAL_35, *SENSOR)
    copied.get_ifd(EXIF).update({tag: exposure[tag] for tag in wanted if tag in exposure})
    lens = [exif.get(MAKE), exif.get(MODEL), exposure.get(FOCAL), exposure.get(FOCAL_35)]
    lens += [f"zoom {zoom}"] if (zoom := exposure.get(ZOOM)) not in (None, 0, 1) else []
    return " ".join(shown(str(part), 40) for part in lens), copied.tobytes()


def _focal_of_larger(exposure, size):
    """A reduced photograph's focal length in pixels, from EXIF's data of the sensor, or None."""
    try:
        across, down, density, unit = (float(exposure[tag]) for tag in SENSOR)
        reduced = max(size[0] / across, size[1] / down)
        focal = float(exposure[FOCAL]) * density / PER_MM[unit] * reduced
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None  # EXIF lacks the tags, or is broken
    is_told = not exposure.get(FOCAL_35) and abs(reduced - 1) > REDUCED
    return focal if is_told and POSSIBLE[0] < focal / max(size) < POSSIBLE[1] else None


def _frames(video, images):
    """Yield the facts of the sharpest frame of each interval, and write it to `images`."""
    chosen, is_hdr = _sharpest(video)
    equal = [f"eq(n,{number})" for number in chosen]
    # in groups, since ffmpeg adds at most a hundred terms
    groups = [f"({'+'.join(equal[i : i + GROUP])})" for i in range(0, len(equal), GROUP)]
    frames = _decoded(video, f"select='{'+'.join(groups)}'" + TONE_MAPPED * is_hdr, "rgb24", 3)
    next(frames)  # the video's metadata
    for number, frame in zip(track(chosen, "frames", "image"), frames, strict=False):
        image, name = Image.fromarray(frame), f"{number:06d}.jpg"
        with atomic_file(images / name) as file:
            image.save(file, "JPEG", **QUALITY)
        facts = {"name": name, "source": f"frame {number}", "lens": "video", "focal": None}
        yield _look(image) | {"uniform": _is_uniform(image)} | facts


def _sharpest(video):
    """(the number of the sharpest frame of each of FRAMES intervals, whether the video is HDR)."""
    frames = _decoded(video, f"scale=w='min({SEEN},iw)':h=-2", "gray", 1)
    meta = next(frames)
    # an estimate: videos that browsers record state no length
    total = round(meta["duration"] * meta["fps"]) or None
    sharpness, pictures, shown = [], [], None  # pictures: each frame's number among distinct ones
    for frame in track(frames, "looking at frames", "frame", total):
        look = _look(Image.fromarray(frame[..., 0]))
        is_new = shown is None or _difference(shown, look) >= SAME
        shown = look if is_new else shown
        sharpness.append(look["sharpness"])
        pictures.append(pictures[-1] + is_new if pictures else 0)
    if not sharpness:
        raise UserError(f"{video}: holds no frames; give another video")
    # repeated frames, as in videos with a constant rate, do not lengthen an interval
    if total and len(sharpness) < WHOLE_SHARE * total:
        what = f"only {len(sharpness)} of its {total} frames are there; copy it again for the rest"
        warnings.warn(f"{video}: {what}", stacklevel=1)
    count = max(pictures[-1] + 1, FRAMES)
    intervals = groupby(range(len(pictures)), lambda number: pictures[number] * FRAMES // count)
    is_hdr = any(transfer in meta.get("pix_fmt", "") for transfer in HDR)
    return [max(numbers, key=sharpness.__getitem__) for _, numbers in intervals], is_hdr


def _decoded(video: Path, filters: str, pixels: str, channels: int) -> Iterator[Any]:
    """Yield the video's metadata, then its filtered frames, (H, W, channels) uint8."""
    # it warns about rotated videos, which phones make
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    decoded = needed("imageio_ffmpeg").read_frames(
        video,
        pixels,
        bits_per_pixel=8 * channels,
        input_params=LOCAL,
        output_params=["-vf", f"{WHOLE},{SQUARE},{filters}", *EACH_ONCE],
    )
    try:
        yield (meta := next(decoded))
        for content in decoded:
            yield np.frombuffer(content, np.uint8).reshape(*meta["size"][::-1], channels)
    except (OSError, RuntimeError, ValueError, IndexError, KeyError, StopIteration) as error:
        # ffmpeg's last line that names an error, without its banner
        lines = [line for line in str(error).splitlines() if "rror" in line or "nvalid" in line]
        reason = re.sub(r"^\[[^]]*\]\s*", "", lines[-1]) if lines else str(error).partition("\n")[0]
        raise UserError(
            f"{video}: cannot be read as a video ({shown(reason, 100)}); give an MP4, MOV or WebM,"
            " or a folder of photographs"
        ) from None


def _look(image):
    """An image's sharpness (the variance of its Laplacian), size and small copy."""
    cv2 = needed("cv2")
    gray = image.convert("L")
    gray.thumbnail((SEEN, SEEN), Image.Resampling.BOX)
    sharpness = float(cv2.Laplacian(np.array(gray), cv2.CV_64F).var())
    small = np.array(gray.resize((SMALL, SMALL), Image.Resampling.BOX), np.float32)
    return {"sharpness": round(sharpness, 2), "size": image.size, "small": small}


def _is_uniform(image):
    """Whether the border of an image shows one colour, which is the background's."""
    small = image.convert("RGB")
    small.thumbnail((SEEN, SEEN), Image.Resampling.BOX)
    return is_uniform(np.array(small))


def _leave_out(taken):
    """Add a reason to each image that is empty, blurred or like the one before."""

    def near(values, i):
        return np.median(values[max(0, i - NEIGHBOURS) : i + NEIGHBOURS + 1])

    good = [image for image in taken if "reason" not in image]
    sharpness = [image["sharpness"] for image in good]
    for i, image in enumerate(good):
        usual = near(sharpness, i)
        if image["sharpness"] < EMPTY:
            image["reason"] = "shows nothing sharp"
        elif image["sharpness"] < BLURRED * usual:
            image["reason"] = (
                f"is blurred (sharpness {image['sharpness'] / usual:.0%} of the usual)"
            )
    good = [image for image in good if "reason" not in image]
    steps = [_difference(*two) for two in pairwise(good)]
    last = good[0] if good else None
    for i, image in enumerate(good[1:]):
        if _difference(last, image) < max(SAME, ALIKE * near(steps, i)):
            image["reason"] = f"shows the same as {last['source']}"
        else:
            last = image


def _difference(look, other):
    """Mean difference of two images' small copies, in levels, apart from their brightness."""
    a, b = (image["small"] - image["small"].mean() for image in (look, other))
    return float(np.abs(a - b).mean())


def write_images(dev: Device, frames: Path, images: Path, image_files: Sequence[ImageFile]) -> int:
    """Write the photographs without distortion into the folder `images`, except those already
    there, with the same names and formats and for the given cameras. Returns the number written.

    frames: the folder of the distorted photographs. Raises UserError if the distortion folds one
    over, and as read_rgba() and write_png() do.
    """
    for image_file in image_files:
        if image_file.lens.folds(image_file.camera):
            raise UserError(
                f"{frames / Path(image_file.name).name}: the lens that was found folds the image"
                " over; take more photographs with more overlap, and do not zoom"
            )
    images.mkdir(exist_ok=True)
    unwritten = [
        image_file
        for image_file in image_files
        if not (images / Path(image_file.name).name).is_file()
    ]

    def write(image_file):
        name = Path(image_file.name).name
        image = read_rgba(frames / name)
        if image_file.lens:
            image = undistort(dev, image, image_file.camera, image_file.lens)
        if name.endswith(".png"):
            is_opaque = (image[..., 3] == 255).all()
            write_png(images / name, image[..., :3] if is_opaque else image)
        else:
            with atomic_file(images / name) as file:
                Image.fromarray(image[..., :3]).save(file, "JPEG", **QUALITY)

    most = max(image_file.camera.width * image_file.camera.height for image_file in image_files)
    with ThreadPoolExecutor(_threads(most)) as pool:
        made = pool.map(write, unwritten)
        list(track(made, "images", "image", len(unwritten)))
    return len(unwritten)


def undistorted_mask(dev: Device, mask: np.ndarray, image_file: ImageFile) -> np.ndarray:
    """(H, W) uint8 mask of the undistorted image, from the (H, W) uint8 mask of a photograph."""
    if not image_file.lens:
        return mask
    planes = np.dstack([mask] * 4)
    return undistort(dev, planes, image_file.camera, image_file.lens)[..., 3]
