"""OpenEXR images (linear light, premultiplied by alpha, with depth), by the package OpenEXR."""

from pathlib import Path

import numpy as np
import OpenEXR

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_path
from pp_cl.files.picture import Picture


def picture_channels(picture: Picture) -> dict[str, np.ndarray]:
    """{channel: (H, W) float32} of a picture: R, G, B, A; Z, the median depth, and mean.Z, both
    infinite where nothing is; feature.00 to feature.15 where the picture has them.
    """
    colour = picture.premultiplied_linear()
    channels = {name: colour[..., i] for i, name in enumerate("RGBA")}
    channels |= {"Z": picture.median_depth, "mean.Z": picture.depth}
    if picture.features is not None:
        count = picture.features.shape[2]
        channels |= {f"feature.{i:02d}": picture.features[..., i] for i in range(count)}
    return {name: np.ascontiguousarray(array, np.float32) for name, array in channels.items()}


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
        part = OpenEXR.File(str(path), separate_channels=True)
        return {name: channel.pixels for name, channel in part.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:120]
        raise UserError(f"{path}: cannot be read as OpenEXR ({reason}); copy it anew") from error
