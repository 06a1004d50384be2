"""A scene as NeRF-synthetic has it, transforms_<split>.json with RGBA images, and nerfstudio's keys
for the intrinsics.
"""

from pathlib import Path

from pp_cl.engine.views import View
from pp_cl.scene.readers.transforms import write_scene


def write(folder: Path, splits: dict[str, list[View]]) -> None:
    """Write the views, under their names with the ending .png."""
    write_scene(splits, folder)
