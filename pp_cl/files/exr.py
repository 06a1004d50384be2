"""OpenEXR images (linear light, premultiplied by alpha, with depth), by the package OpenEXR."""

import os
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import Imath
import numpy as np
import OpenEXR

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_path
from pp_cl.files.srgb import linear_to_srgb
from pp_cl.files.untrusted import MOST_PIXELS, refusal

COLOURS = (("R", "G", "B"), ("Y",))  # what makes an image
STRIP = 256  # rows that are read at once: the most that a compression of OpenEXR has in a chunk
# bytes of a strip, or of a tile, with all of its channels: they are unpacked together
MOST_CHUNK = 2**29
FLOAT = Imath.PixelType(Imath.PixelType.FLOAT)
_one_at_a_time = threading.Lock()


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write channels, (H, W) float32 each, without loss, atomically. Raises UserError naming the
    file when it cannot be written.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, dict(channels)).write(str(temporary))


def exr_size(path: Path | str) -> tuple[int, int]:
    """(width, height) of the display window of an image, from its header. Raises UserError as
    read_exr_rgba does.
    """
    return _size(path, _header(path)["displayWindow"])


def read_exr_rgba(path: Path | str) -> np.ndarray:
    """(H, W, 4) uint8 straight sRGB of an image's display window.

    Linear light between 0 and 1 becomes sRGB, what is brighter is cut off; no alpha means 255, and
    outside of the data window nothing is there: alpha 0. Only the channels of the image are kept,
    STRIP rows at a time. Raises UserError naming a file that is missing or broken, has several
    parts, no colours, or more pixels than are read, or holds NaN or infinite pixels.
    """
    header = _header(path)
    width, height = _size(path, header["displayWindow"])
    columns, rows = _size(path, header["dataWindow"])
    names = _wanted(path, header, (columns, rows))
    (left, top), (right, bottom) = (np.array(corner, int) for corner in header["displayWindow"])
    x, y = (int(v) for v in header["dataWindow"][0])
    begin, end = max(x, left), min(x + columns, right + 1)
    image, broken = np.zeros((height, width, 4), np.uint8), 0
    with _refused(path):
        file = OpenEXR.InputFile(str(path))
    with closing(file):
        for first in range(y, y + rows if begin < end else y, STRIP):
            last = min(first + STRIP, y + rows) - 1
            low, high = max(first, top), min(last, bottom) + 1
            if low < high:
                planes = _strip(path, file, names, (first, last))
                planes = planes[low - first : high - first, begin - x : end - x]
                broken += int((~np.isfinite(planes)).any(axis=2).sum())
                if not broken:
                    image[low - top : high - top, begin - left : end - left] = _straight(planes)
    if broken:
        raise UserError(f"{path}: {broken} pixels are NaN or infinite; fix or remove the image")
    return image


def _straight(planes):
    """(H, W, 4) uint8 straight sRGB of linear, premultiplied light."""
    alpha = np.clip(planes[..., 3:], 0, 1)
    colour = linear_to_srgb(np.clip(planes[..., :3] / np.maximum(alpha, 1e-6), 0, 1))
    return (np.concatenate([colour, alpha], axis=2) * 255 + 0.5).astype(np.uint8)


def _header(path):
    """The header of a file of one part with pixels. Raises UserError."""
    if not Path(path).is_file():
        raise UserError(f"{path}: no such file; copy it there")
    with _refused(path):
        parts = OpenEXR.File(str(path), header_only=True).parts
        headers = [part.header for part in parts]
    if len(headers) > 1:
        raise UserError(f"{path}: has {len(headers)} parts; save the image as a file of one part")
    if not headers or headers[0].get("type") not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise UserError(f"{path}: holds no image of scanlines or tiles; save it as one")
    return headers[0]


@contextmanager
def _refused(path) -> Iterator[None]:
    """What the library raises becomes a UserError, and what it prints by itself goes nowhere."""
    with _one_at_a_time:
        kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        try:
            yield
        except Exception as error:  # the library's exceptions have no common class
            raise refusal(path, error, "OpenEXR") from error
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nowhere)


def _size(path, window):
    """(width, height) of a window of the header. Raises UserError for one that no image has."""
    width, height = (int(v) for v in np.array(window[1], int) - np.array(window[0], int) + 1)
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise UserError(
            f"{path}: {width}x{height} pixels, which must be 1 to {MOST_PIXELS}; copy the file"
            " again, or reduce it"
        )
    return width, height


def _wanted(path, header, size):
    """The names of R, G, B, or of Y three times, and of A where it is there. Raises UserError."""
    channels = {channel.name: channel for channel in header["channels"]}
    layers = {name[: name.rfind(".") + 1] for name in channels}  # with the point behind their name
    found = [
        (layer, [layer + name for name in colours])
        for layer in sorted(layers)
        for colours in COLOURS
        if all(layer + name in channels for name in colours)
    ]
    whole = [entry for entry in found if entry[0] == ""] or found
    if len(whole) != 1:
        raise UserError(
            f"{path}: has {'no' if not whole else 'several'} images among its channels"
            f" ({', '.join(sorted(channels))[:80]}); keep one of R, G, B and A, or of Y"
        )
    layer, colours = whole[0]
    names = colours * (3 // len(colours)) + [f"{layer}A"] * (f"{layer}A" in channels)
    if any((channels[name].xSampling, channels[name].ySampling) != (1, 1) for name in names):
        raise UserError(f"{path}: its channels differ in size; save it without subsampling")
    tiles = header.get("tiles")
    pixels = tiles.xSize * tiles.ySize if tiles else size[0] * min(size[1], STRIP)
    if 4 * len(channels) * pixels > MOST_CHUNK:
        raise UserError(
            f"{path}: {len(channels)} channels of {pixels} pixels are packed together, more than"
            f" {MOST_CHUNK} bytes; save R, G, B and A alone"
        )
    return names


def _strip(path, file, names, rows):
    """(H, W, 4) float32 of the rows (first, last) of the data window. Raises UserError."""
    with _refused(path):
        wanted = list(dict.fromkeys(names))
        read = dict(zip(wanted, file.channels(wanted, FLOAT, *rows), strict=True))
    count = rows[1] - rows[0] + 1
    planes = [np.frombuffer(read[name], np.float32).reshape(count, -1) for name in names]
    if len(planes) == 3:
        planes.append(np.ones_like(planes[0]))
    return np.stack(planes, axis=2)
