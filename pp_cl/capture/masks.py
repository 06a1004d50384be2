"""Masks of the photographs: white where the object is."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pp_cl.files.image import read_rgba, write_png
from pp_cl.scene.masks import MaskRule
from pp_cl.scene.views import Photograph


def mask_file(folder: Path, name: str) -> Path:
    """Where write_masks() writes the mask of a photograph."""
    return folder / f"{Path(name).stem}.png"


def write_masks(
    scene: Path,
    folder: Path,
    photographs: Sequence[Photograph],
    box: np.ndarray,
    points: np.ndarray,
    seen: Sequence[np.ndarray],
    *,
    given: Path | None = None,
    command: str | None = None,
    behind: Mapping[str, np.ndarray] | None = None,
) -> str:
    """Write the mask of each photograph as mask_file(); returns how they were made."""
    folder.mkdir(parents=True, exist_ok=True)
    rule = MaskRule("color", str(given or ""))
    for one in photographs:
        image = rule.apply(read_rgba(scene / one.name), Path(one.name).name, None)
        write_png(mask_file(folder, one.name), image[..., 3])
    return "given" if given else "of a uniform background"
