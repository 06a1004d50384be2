"""Reads and writes OpenEXR images (linear light, premultiplied by alpha, with depth)."""

from contextlib import closing
from pathlib import Path

import Imath
import numpy as np
import OpenEXR

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_path
from pp_cl.files.srgb import linear_to_srgb
from pp_cl.files.untrusted import MOST_PIXELS, refusal

COLOURS = (("R", "G", "B"), ("Y",))  # channels that make an image
# bytes of a tile, or of all rows that are compressed together, with all channels; most such rows
MOST_CHUNK, CHUNK_ROWS = 2**29, 256
FLOAT = Imath.PixelType(Imath.PixelType.FLOAT)


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write channels, (H, W) float32 each, losslessly and atomically. Raises UserError naming a
    file that cannot be written.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, dict(channels)).write(str(temporary))


def exr_size(path: Path | str) -> tuple[int, int]:
    """(width, height) of an image's display window, from its header. Raises UserError as
    read_exr_rgba() does.
    """
    return _window(path, _header(path), "displayWindow")[1]


def read_exr_rgba(path: Path | str) -> np.ndarray:
    """(H, W, 4) uint8 straight sRGB of an image's display window: linear light above 1 is clipped,
    a missing alpha means 255, and outside the data window alpha is 0. Raises UserError naming a
    file that is missing or broken, or has several parts, no colours, too many pixels, NaN or Inf.
    """
    header = _header(path)
    first_shown, (width, height) = _window(path, header, "displayWindow")
    first, (columns, rows) = _window(path, header, "dataWindow")
    names = _wanted(path, header, columns * min(rows, CHUNK_ROWS))
    try:
        with closing(OpenEXR.InputFile(str(path))) as file:
            channels = file.channels(names, FLOAT)
            planes = [
                np.frombuffer(channel, np.float32).reshape(rows, columns) for channel in channels
            ]
    except Exception as error:  # the library's exceptions have no common class
        raise refusal(path, error, "OpenEXR") from error
    broken = ~np.logical_and.reduce([np.isfinite(plane) for plane in planes])
    if broken.any():
        raise UserError(
            f"{path}: {broken.sum()} pixels are NaN or infinite; fix or remove the image"
        )
    stored = np.empty((rows, columns, 4), np.uint8)
    for row, light in enumerate(zip(*planes, strict=True)):
        stored[row] = _straight(np.stack(light, axis=1))
    image = np.zeros((height, width, 4), np.uint8)
    x, y = first - first_shown
    left, right = np.clip([x, x + columns], 0, width)
    top, bottom = np.clip([y, y + rows], 0, height)
    image[top:bottom, left:right] = stored[top - y : bottom - y, left - x : right - x]
    return image


def _straight(light):
    """(N, 4) uint8 straight sRGB from linear, premultiplied gray or RGB, maybe with alpha."""
    count = light.shape[1]
    colours, alpha = (light, 1) if count % 2 else (light[:, :-1], np.clip(light[:, -1:], 0, 1))
    rgba = np.empty((len(light), 4), np.float32)
    rgba[:, :3] = linear_to_srgb(np.clip(colours / np.maximum(alpha, 1e-6), 0, 1))
    rgba[:, 3:] = alpha
    return (rgba * 255 + 0.5).astype(np.uint8)


def _header(path):
    """The header of a file that must have one part with pixels. Raises UserError."""
    if not Path(path).is_file():
        raise UserError(f"{path}: no such file; copy it there")
    try:
        headers = [part.header for part in OpenEXR.File(str(path), header_only=True).parts]
    except Exception as error:  # the library's exceptions have no common class
        raise refusal(path, error, "OpenEXR") from error
    if len(headers) > 1:
        raise UserError(f"{path}: has {len(headers)} parts; save the image as a file of one part")
    if not headers or headers[0].get("type") not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise UserError(f"{path}: holds no image of scanlines or tiles; save it as one")
    return headers[0]


def _window(path, header, name):
    """(x and y of the first pixel, (width, height)) of a window in the header. Raises UserError."""
    first, last = (np.array(corner, int) for corner in header[name])
    width, height = map(int, last - first + 1)
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise UserError(
            f"{path}: {width}x{height} pixels, but must have 1 to {MOST_PIXELS}; copy the file"
            " again, or reduce it"
        )
    return first, (width, height)


def _wanted(path, header, chunk):
    """The names of the channels R, G and B, or Y, and A. chunk: pixels compressed together."""
    channels = {channel.name: channel for channel in header["channels"]}
    layers = {name[: name.rfind(".") + 1] for name in channels}  # including the point at the end
    images = [
        (layer, [layer + name for name in colours])
        for layer in sorted(layers)
        for colours in COLOURS
        if all(layer + name in channels for name in colours)
    ]
    whole = [image for image in images if image[0] == ""] or images
    if len(whole) != 1:
        raise UserError(
            f"{path}: has {'no' if not whole else 'several'} images among its channels"
            f" ({', '.join(sorted(channels))[:80]}); keep one image with R, G, B and A, or with Y"
        )
    layer, names = whole[0]
    names += [f"{layer}A"] * (f"{layer}A" in channels)
    if any((channels[name].xSampling, channels[name].ySampling) != (1, 1) for name in names):
        raise UserError(f"{path}: its channels differ in size; save it without subsampling")
    tiles = header.get("tiles")
    packed = 4 * len(channels) * (tiles.xSize * tiles.ySize if tiles else chunk)
    if packed > MOST_CHUNK:
        raise UserError(
            f"{path}: {len(channels)} channels are packed together in {packed} bytes, more than"
            f" {MOST_CHUNK}; save R, G, B and A alone"
        )
    return names
