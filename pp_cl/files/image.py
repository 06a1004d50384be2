"""Reads and writes 8-bit image files."""

import io
import posixpath
import warnings
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError

from pp_cl.errors import Unusable, UserError
from pp_cl.files.atomic import atomic_file
from pp_cl.files.exr import exr_size, read_exr_rgba
from pp_cl.files.untrusted import MOST_PIXELS, opened_regular, refusal

# silences Pillow's own warnings about hundreds of millions of pixels and broken animations
warnings.filterwarnings("ignore", module=r"PIL\.")
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "AVIF")  # JPEG also opens the MPO of phones
# endings of the files that read_rgba() reads; formats that may have alpha come first
ENDINGS = (".png", ".webp", ".tif", ".tiff", ".avif", ".jpg", ".jpeg", ".jfif", ".bmp", ".exr")
# A profile is sRGB's if it moves none of PROBED**3 colours by more than AS_SRGB levels of 255.
PROBED, AS_SRGB = 6, 4
# Pillow's names of the modes that convert to RGBA without loss
EIGHT_BIT_MODES = ("RGBA", "RGB", "LA", "L", "PA", "P", "1")
# Pillow's names of the modes that are converted to these first: inks, video, premultiplied alpha
CONVERTED = {"CMYK": "RGB", "YCbCr": "RGB", "RGBa": "RGBA", "La": "LA"}
LOSSY = (".jpg", ".jpeg", ".jfif")
ORIENTATION = 0x0112  # EXIF's tag
QUARTERS = {6: 1, 3: 2, 8: 3}  # quarter turns clockwise, for orientations that do not mirror
ON_THEIR_SIDE = (5, 6, 7, 8)  # orientations that swap width and height
UNREADABLE = "an image that cannot be read"
# A mask may have been a JPEG with subsampled colours, or have a coloured rim. It counts as coloured
# if COLOURED of the cells that are lighter than DARK differ by more than COLOURLESS levels between
# the channels; a cell is the mean of 4 x 4 pixels of the mask resized to COLOUR_SIDE.
COLOUR_SIDE, COLOURLESS, DARK, COLOURED = 512, 16, 64, 0.3
# A mask holds class labels instead of alpha if its values are at most MOST_LABEL and the share FLAT
# of its pixels equals the pixel to the left.
MOST_LABEL, FLAT = 40, 0.8
# the byte of a PNG's first chunk, its header, that holds the bits per channel
PNG_SIGNATURE, PNG_DEPTH_BYTE = b"\x89PNG\r\n\x1a\n", 24


def read_rgba(
    path: Path | str, size: tuple[int, int] | None = None, *, turned: bool = False
) -> np.ndarray:
    """(H, W, 4) uint8 straight sRGB and alpha of an image file of any kind; a missing alpha means
    255. The EXIF orientation is applied if `turned`, or if the image has the expected (width,
    height) `size` only when it lies on its side. Raises Unusable naming a file that is missing,
    truncated, not an image, larger than MOST_PIXELS, or holds numbers of another kind.
    """
    with _opened(path) as image:
        if turned or (size is not None and size == image.size[::-1] != image.size):
            ImageOps.exif_transpose(image, in_place=True)
        srgb = in_srgb(path, image)
        rgba = np.array(srgb if srgb.mode == "RGBA" else srgb.convert("RGBA"))
        if image.format == "TIFF" and size == rgba.shape[:2] != rgba.shape[1::-1]:
            reason = "its orientation turns it, but its camera is that of the stored pixels"
            raise Unusable(f"{path}: {reason}; write it upright", UNREADABLE)
        return rgba


def in_srgb(path: Path | str, image: Image.Image) -> Image.Image:
    """An opened image file, converted to sRGB and one of EIGHT_BIT_MODES. Raises Unusable."""
    is_deep_gray = image.mode.startswith("I")
    if is_deep_gray or is_deep_png(path):
        _tell(path, "images of 16 bits a channel are read as 8")
    if is_deep_gray:
        levels = np.array(image)
        if levels.min() < 0 or levels.max() > 65535:
            raise Unusable(f"{path}: holds more than 16 bits; write 8", "numbers of another kind")
        return Image.fromarray(((levels.astype(np.uint32) + 128) // 257).astype(np.uint8))
    if image.mode not in (*EIGHT_BIT_MODES, *CONVERTED):
        raise Unusable(
            f"{path}: not 8 or 16 bits a channel of gray or RGB ({image.mode}); convert it to 8-bit"
            " RGBA PNG",
            "numbers of another kind",
        )
    if (profile := image.info.get("icc_profile")) and image.mode in ("RGB", "RGBA", "CMYK"):
        with suppress(ImageCms.PyCMSError, OSError):  # ignores a broken profile
            if image.mode == "CMYK" or not _is_srgb(profile):
                image = _from_profile(image, profile)
                _tell(path, "images with a colour profile of their own are read as sRGB")
    return image.convert(CONVERTED[image.mode]) if image.mode in CONVERTED else image


@lru_cache(maxsize=16)
def _is_srgb(profile):
    """Whether a profile leaves RGB as it is, whatever its name says."""
    levels = np.linspace(0, 255, PROBED).round().astype(np.uint8)
    probe = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3)
    converted = np.array(_from_profile(Image.fromarray(probe), profile), int)
    return bool(np.abs(converted - probe).max() <= AS_SRGB)


def _from_profile(image, profile):
    mode = "RGBA" if image.mode == "RGBA" else "RGB"
    known, srgb = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    return ImageCms.profileToProfile(image, known, srgb, outputMode=mode) or image


def _tell(path, what):
    """Warn how images are changed, once per folder."""
    warnings.warn(f"{Path(path).parent}: {what}", stacklevel=1)


def is_transparent(path: Path | str) -> bool:
    """Whether an image file has pixels that are not opaque. Raises Unusable as read_rgba() does."""
    with _opened(path, checked=False) as image:
        has_alpha = image.has_transparency_data
        return has_alpha and image.convert("RGBA").getchannel("A").getextrema()[0] < 255


def read_mask(path: Path | str) -> np.ndarray:
    """(H, W) uint8, 255 on the object: the alpha of an image that has transparent pixels, or else
    its gray. Raises UserError as read_rgba() does, and for a mask with coloured areas.
    """
    with _opened(path) as opened:
        image = in_srgb(path, opened).copy()
    if image.mode != "L":
        rgba = image.convert("RGBA")
        alpha = np.array(rgba.getchannel("A"))
        if alpha.min() < 255:
            return alpha
        image = rgba.convert("RGB")
        sample = image.resize((COLOUR_SIDE, COLOUR_SIDE), Image.Resampling.NEAREST)
        cells = np.array(sample).reshape(128, 4, 128, 4, 3).mean((1, 3))
        shown = cells[cells.max(2) > DARK]
        if len(shown) and (np.ptp(shown, axis=1) > COLOURLESS).mean() > COLOURED:
            raise UserError(f"{path}: has colours; write a gray mask, white where the object is")
        image = image.convert("L")
    gray = np.array(image)
    if 1 < gray.max() <= MOST_LABEL and _is_flat(gray):
        _tell(path, "masks of labels are read as the object wherever the label is not 0")
        return np.where(gray > 0, np.uint8(255), np.uint8(0))
    if gray.max() == 1:  # a JPEG may hold noise of that size
        if Path(path).suffix.lower() in LOSSY:
            raise UserError(f"{path}: its largest value is 1 of 255; write 255 where the object is")
        _tell(path, "masks of 0 and 1 are read as 0 and 255")
        return gray * np.uint8(255)
    return gray


def _is_flat(gray):
    """Whether the nonzero values of (H, W) are areas and not noise."""
    shown = gray[:, 1:] > 0
    return bool((gray[:, 1:] == gray[:, :-1])[shown].mean() > FLAT) if shown.any() else False


def image_size(path: Path | str, stated: tuple[float, float] | None = None) -> tuple[int, int]:
    """(width, height) from the header of an image file, turned as its EXIF says if only then it has
    the aspect ratio of the stated size. Raises UserError as read_rgba() does.
    """
    if size := _exr(exr_size, path):
        return size
    with _opened(path, checked=False) as image:
        size = image.size
        if stated and not same_shape(size, stated) and same_shape(size[::-1], stated):
            is_turned = image.getexif().get(ORIENTATION) in ON_THEIR_SIDE
            size = size[::-1] if is_turned else size
        return size


def exif_turns(path: Path | str) -> int:
    """The quarter turns clockwise by which a picture's EXIF says to show it; 0 without EXIF, and
    for TIFF, which Pillow turns itself. Raises Unusable as read_rgba() does.
    """
    if Path(path).suffix.lower() == ".exr":
        return 0
    with _opened(path, checked=False) as image:
        # getexif() would decode a PNG without EXIF
        has_exif = "exif" in image.info if image.format == "PNG" else image.format != "TIFF"
        return QUARTERS.get(image.getexif().get(ORIENTATION), 0) if has_exif else 0


def same_shape(size: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two sizes have the same aspect ratio, up to rounding."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(other)


def _exr(read, path):
    """read(path) of an OpenEXR file; None for other files. Raises Unusable."""
    if Path(path).suffix.lower() != ".exr":
        return None
    try:
        return read(path)
    except UserError as error:
        raise Unusable(error, UNREADABLE) from error


@contextmanager
def _opened(path, checked=True):
    """The opened image file; errors in the block become Unusable. checked: verify the checksums of
    a PNG, which its decoder ignores.
    """
    if (light := _exr(read_exr_rgba, path)) is not None:
        yield Image.fromarray(light)
        return
    try:
        with opened_regular(path) as file:
            if checked and file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
                Image.open(file, formats=FORMATS).verify()
            with Image.open(file, formats=FORMATS) as image:
                yield image
    except UserError:
        raise
    except Image.DecompressionBombError:
        text = f"{path}: more than {MOST_PIXELS} pixels; reduce the image"
        raise Unusable(text, UNREADABLE) from None
    except UnidentifiedImageError:  # its first bytes count, not its name
        text = f"{path}: is no {', '.join(FORMATS)}; convert it, or copy it again"
        raise Unusable(text, UNREADABLE) from None
    # decoders raise all kinds of exceptions on broken bytes: OSError, SyntaxError, struct.error
    except Exception as error:
        raise Unusable(str(refusal(path, error, ", ".join(FORMATS))), UNREADABLE) from error


def is_deep_png(path: Path | str) -> bool:
    """Whether a file is a PNG with 16 bits per channel, whose low byte Pillow silently drops."""
    with open(path, "rb") as file:
        head = file.read(PNG_DEPTH_BYTE + 1)
    return head.startswith(PNG_SIGNATURE) and head[PNG_DEPTH_BYTE] == 16


def to_8bit(image: np.ndarray) -> np.ndarray:
    """uint8 image from a float image, clamped to [0, 1] and rounded to the nearest of 256 levels.
    Raises ValueError for NaN.
    """
    image = np.asarray(image)
    if np.isnan(image).any():
        raise ValueError("the image holds NaN")
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_png(path: Path | str, image: np.ndarray) -> None:
    """Write a uint8 or float [0, 1] image of shape (H, W), (H, W, 3) or (H, W, 4), atomically.
    Raises UserError naming a file that cannot be written, ValueError for NaN.
    """
    image = np.asarray(image)
    encoded = io.BytesIO()
    Image.fromarray(image if image.dtype == np.uint8 else to_8bit(image)).save(encoded, "PNG")
    with atomic_file(Path(path)) as file:
        file.write(encoded.getbuffer())


def image_paths(names: list[str]) -> list[PurePosixPath]:
    """Relative paths of PNG files for views with these names, without the folders all share. None
    leads out of the folder to which it is relative.
    """
    paths = [PurePosixPath(posixpath.normpath(f"/{name.lstrip('/')}")) for name in names]
    shared = posixpath.commonpath([path.parent for path in paths])
    paths = [path.relative_to(shared) for path in paths]
    files = [path.with_suffix(".png") for path in paths]
    if len(set(files)) < len(files):  # such as a.jpg and a.png
        files = [path.with_name(f"{path.name}.png") for path in paths]
    return files
