"""OpenEXR images (linear light, premultiplied by alpha, with depth), by the package OpenEXR."""

from pathlib import Path

import numpy as np
import OpenEXR

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_path
from pp_cl.files.colour import linear_to_srgb
from pp_cl.files.regular import refusal

MOST_PIXELS = 2**28  # of an image that is read; beyond, a header is broken
COLOURS = (("R", "G", "B"), ("Y",))  # what makes an image


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write channels, (H, W) float32 each, without loss, atomically. Raises UserError naming the
    file when it cannot be written.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, dict(channels)).write(str(temporary))


def read_exr(path: Path | str) -> dict[str, np.ndarray]:
    """{channel: (H, W)} of an image of one part. Raises UserError naming a file that cannot be
    read.
    """
    try:
        part = _opened(path, separate_channels=True)
        return {name: channel.pixels for name, channel in part.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise refusal(path, error, "OpenEXR") from error


def exr_size(path: Path | str) -> tuple[int, int]:
    """(width, height) of the display window of an image, from its header. Raises UserError as
    read_exr_rgba does.
    """
    return _size(path, _opened(path, header_only=True).header()["displayWindow"])


def read_exr_rgba(path: Path | str) -> np.ndarray:
    """(H, W, 4) uint8 straight sRGB of an image's display window.

    Linear light between 0 and 1 becomes sRGB, what is brighter is cut off; no alpha means 255, and
    outside of the data window nothing is there: alpha 0. Raises UserError naming a file that is
    missing or broken, has no colours, or holds NaN or infinite pixels.
    """
    header = _opened(path, header_only=True).header()
    width, height = _size(path, header["displayWindow"])
    (left, top), (right, bottom) = (np.array(corner, int) for corner in header["dataWindow"])
    _size(path, header["dataWindow"])
    planes = _planes(path, read_exr(path), (bottom - top + 1, right - left + 1))
    image = np.zeros((height, width, 4), np.float32)
    x, y = (int(v) for v in np.array([left, top]) - header["displayWindow"][0])
    there = image[max(y, 0) : max(y + planes.shape[0], 0), max(x, 0) : max(x + planes.shape[1], 0)]
    there[:] = planes[max(-y, 0) :, max(-x, 0) :][: there.shape[0], : there.shape[1]]
    alpha = np.clip(image[..., 3:], 0, 1)
    colour = linear_to_srgb(np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0, 1))
    return (np.concatenate([colour, alpha], axis=2) * 255 + 0.5).astype(np.uint8)


def _opened(path, **options):
    """The OpenEXR.File. Raises UserError."""
    if not Path(path).is_file():
        raise UserError(f"{path}: no such image; copy it there")
    try:
        return OpenEXR.File(str(path), **options)
    except Exception as error:  # the library's exceptions have no common class
        raise refusal(path, error, "OpenEXR") from error


def _size(path, window):
    """(width, height) of a window of the header. Raises UserError for one that no image has."""
    width, height = (int(v) for v in np.array(window[1], int) - np.array(window[0], int) + 1)
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise UserError(f"{path}: {width}x{height} pixels is no size; copy the file anew")
    return width, height


def _planes(path, channels, shape):
    """(H, W, 4) float32 linear, premultiplied, of the channels of the data window. Raises
    UserError.
    """
    layers = {name.rpartition(".")[0] for name in channels}
    found = [
        (layer, [f"{layer}.{name}" if layer else name for name in colours])
        for layer in sorted(layers)
        for colours in COLOURS
        if all((f"{layer}.{name}" if layer else name) in channels for name in colours)
    ]
    whole = [entry for entry in found if entry[0] == ""] or found
    if len(whole) != 1:
        raise UserError(
            f"{path}: has {'no' if not whole else 'several'} images among its channels"
            f" ({', '.join(sorted(channels))[:80]}); keep one of R, G, B and A, or of Y"
        )
    layer, colours = whole[0]
    alpha = channels.get(f"{layer}.A" if layer else "A")
    planes = [channels[name] for name in colours] * (3 // len(colours))
    planes.append(np.ones(shape, np.float32) if alpha is None else alpha)
    if any(plane.shape != shape for plane in planes):
        raise UserError(f"{path}: its channels differ in size; save it without subsampling")
    image = np.stack(planes, axis=2).astype(np.float32)
    broken = int((~np.isfinite(image)).any(axis=2).sum())
    if broken:
        raise UserError(f"{path}: {broken} pixels are NaN or infinite; mend or remove the image")
    return image
