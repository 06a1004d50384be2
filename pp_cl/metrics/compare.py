"""Measures PSNR, SSIM and LPIPS of an image, or a folder of images, against the ground truth."""

import mimetypes
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.engine.device.device import Device
from pp_cl.errors import UserError
from pp_cl.files.image import ENDINGS, read_rgba
from pp_cl.metrics.psnr_ssim import Metrics, mean


def compare(
    prediction: Path | str,
    truth: Path | str,
    metrics: tuple[str, ...] = ("psnr", "ssim"),
    dev: Device | None = None,
) -> dict[str, Any]:
    """Metrics of two images over white, or of two folders whose images have the same names:
    {"mean": {metric: number}, "per_image": [{"name", metric: number, ...}]}. metrics: from psnr,
    ssim and lpips, which needs dev. Raises UserError naming a file that is missing or unreadable,
    or has no partner or another size than its partner.
    """
    rows, measure = [], Metrics(dev, metrics)
    for file, other in _pairs(Path(prediction), Path(truth)):
        a, b = read_over_white(file), read_over_white(other)
        if a.shape != b.shape:
            raise UserError(
                f"{file}: {a.shape[1]}x{a.shape[0]} pixels, but {other} has"
                f" {b.shape[1]}x{b.shape[0]}; sizes must agree"
            )
        try:
            rows.append({"name": file.name, **measure(a, b)})
        except UserError as error:
            raise UserError(f"{file}: {error}") from None
    return {"mean": mean(rows), "per_image": rows}


def _pairs(prediction, truth):
    if not prediction.is_dir() and not truth.is_dir():
        return [(prediction, truth)]
    for path in (prediction, truth):
        if not path.is_dir():
            raise UserError(f"{path}: not a folder; compare two images or two folders")
    names = [_image_names(folder) for folder in (prediction, truth)]
    for folder, lacking in ((prediction, names[1] - names[0]), (truth, names[0] - names[1])):
        if lacking:
            raise UserError(
                f"{folder / min(lacking)}: missing ({len(lacking)} in all); "
                "both folders must hold images of the same names"
            )
    if not names[0]:
        raise UserError(f"{prediction}: no images ({', '.join(ENDINGS)}) in it")
    return [(prediction / name, truth / name) for name in sorted(names[0])]


def _image_names(folder):
    """Names of the images in a folder, without hidden files such as macOS adds."""
    paths = [path for path in folder.iterdir() if not path.name.startswith(".")]
    for path in paths:
        kind = mimetypes.guess_type(path.name, strict=False)[0] or ""
        if kind.startswith("image/") and path.suffix.lower() not in ENDINGS:
            raise UserError(
                f"{path}: pp-cl cannot read this format; convert it to PNG, or move it away"
            )
    return {path.name for path in paths if path.suffix.lower() in ENDINGS}


def read_over_white(path: Path | str) -> np.ndarray:
    """The image in a file, over white: (H, W, 3) float64 in [0, 1]. Raises UserError naming it."""
    rgba = read_rgba(path) / 255.0
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + (1 - alpha)
