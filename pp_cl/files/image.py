"""Reads and writes 8-bit image files."""

import io
import warnings
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file
from pp_cl.files.exr import exr_size, read_exr_rgba
from pp_cl.files.untrusted import MOST_PIXELS, opened_regular, refusal

# Pillow warns of pixels by the hundred million, and of broken animations, in words of its own
warnings.filterwarnings("ignore", module=r"PIL\.")
FORMATS = ("PNG", "JPEG", "WEBP")
ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".exr")  # of the files that read_rgba reads
# Pillow's names of what converts to RGBA without loss
EIGHT_BIT_MODES = ("RGBA", "RGB", "LA", "L", "PA", "P", "1")
# A mask may have been a JPEG with subsampled colours: means of blocks, of which the shorter side
# has this many, differ by no more than so many levels between the channels
COLOUR_SIDE, COLOURLESS = 16, 16
# bits per channel stand in the header chunk, the first of all
PNG_SIGNATURE, PNG_DEPTH_BYTE = b"\x89PNG\r\n\x1a\n", 24


def read_rgba(path: Path | str) -> np.ndarray:
    """(H, W, 4) uint8 straight RGBA of an image file; gray and palette colours are expanded, no
    alpha means 255; OpenEXR as read_exr_rgba has it.

    Raises UserError naming a file that is missing, truncated, no image, larger than MOST_PIXELS, or
    has other than 8 bits a channel.
    """
    if _is_exr(path):
        return read_exr_rgba(path)
    with _opened(path) as image:
        _check_depth(path, image)
        return np.array(image if image.mode == "RGBA" else image.convert("RGBA"))


def _check_depth(path, image):
    """Raise UserError where an opened image has other than 8 bits a channel of gray or RGB."""
    is_deep = is_deep_png(path)
    if image.mode not in EIGHT_BIT_MODES or is_deep:
        found = "16 bits" if is_deep else image.mode
        raise UserError(
            f"{path}: not 8 bits a channel of gray or RGB ({found}); convert it to 8-bit RGBA PNG"
        )


def read_mask(path: Path | str) -> np.ndarray:
    """(H, W) uint8, 255 where the object is: the alpha of an image that has transparent pixels, as
    a cut-out, else its gray, of which colour that JPEG or a camera's program left in noise and rims
    is no part. Raises UserError as read_rgba does, and for one with areas of colour.
    """
    if _is_exr(path):
        return _mask_of(path, Image.fromarray(read_exr_rgba(path)))
    with _opened(path) as image:
        _check_depth(path, image)
        return _mask_of(path, image)


def _mask_of(path, image):
    if image.mode != "L":
        rgba = image.convert("RGBA")
        alpha = rgba.getchannel("A")
        if alpha.getextrema()[0] < 255:
            return np.array(alpha)
        image = rgba.convert("RGB")
        block = max(1, min(image.size) // COLOUR_SIDE)
        colours = np.array(image.reduce(block), np.int16)
        if np.ptp(colours, axis=2).max() > COLOURLESS:
            raise UserError(f"{path}: has colours; write a gray mask, white where the object is")
        image = image.convert("L")
    if image.getextrema()[1] == 1:
        raise UserError(f"{path}: its largest value is 1 of 255; write 255 where the object is")
    return np.array(image)


def image_size(path: Path | str) -> tuple[int, int]:
    """(width, height) from the header of an image file. Raises UserError as read_rgba does."""
    if _is_exr(path):
        return exr_size(path)
    with _opened(path, checked=False) as image:
        return image.size


def _is_exr(path):
    return Path(path).suffix.lower() == ".exr"


@contextmanager
def _opened(path, checked=True):
    """The image file, opened; what goes wrong with it inside the block becomes a UserError.
    checked: by the checksums of a PNG, at which its decoder does not look.
    """
    try:
        with opened_regular(path) as file:
            if checked and file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
                Image.open(file, formats=FORMATS).verify()
            with Image.open(file, formats=FORMATS) as image:
                yield image
    except UserError:
        raise
    except Image.DecompressionBombError:
        raise UserError(f"{path}: more than {MOST_PIXELS} pixels; reduce the image") from None
    except UnidentifiedImageError:  # by its first bytes, whatever it is called
        raise UserError(
            f"{path}: is no {', '.join(FORMATS)}; convert it, or copy it anew"
        ) from None
    # decoders meet broken bytes with whatever comes up: OSError, SyntaxError, struct.error
    except Exception as error:
        raise refusal(path, error, ", ".join(FORMATS)) from error


def is_deep_png(path: Path | str) -> bool:
    """Whether it is a PNG of 16 bits a channel, of which Pillow silently drops the low byte."""
    with open(path, "rb") as file:
        head = file.read(PNG_DEPTH_BYTE + 1)
    return head.startswith(PNG_SIGNATURE) and head[PNG_DEPTH_BYTE] == 16


def to_8bit(image: np.ndarray) -> np.ndarray:
    """uint8 image of a float image: clamped to [0, 1], rounded to the nearest of 256 levels. Raises
    ValueError for NaN.
    """
    image = np.asarray(image)
    if np.isnan(image).any():
        raise ValueError("the image holds NaN")
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_png(path: Path | str, image: np.ndarray) -> None:
    """Write a uint8 or float [0, 1] image of shape (H, W), (H, W, 3) or (H, W, 4), atomically.

    Raises UserError naming the file when the disk is full or may not be written, ValueError for
    NaN.
    """
    image = np.asarray(image)
    encoded = io.BytesIO()
    Image.fromarray(image if image.dtype == np.uint8 else to_8bit(image)).save(encoded, "PNG")
    with atomic_file(Path(path)) as file:
        file.write(encoded.getbuffer())
