"""Points and meshes as files of trimesh."""

from pathlib import Path

import numpy as np
import trimesh

from pp_cl.export.points import ColouredPoints
from pp_cl.files.atomic import atomic_file
from pp_cl.files.colour import srgb_to_linear
from pp_cl.files.image import to_8bit


def write_point_glb(path: Path | str, points: ColouredPoints) -> None:
    """Write a GLB file of coloured points. Raises UserError as atomic_file does."""
    cloud = trimesh.PointCloud(points.positions, gltf_colours(points.colours))
    with atomic_file(path) as file:
        file.write(cloud.export(file_type="glb"))


def gltf_colours(colours: np.ndarray) -> np.ndarray:
    """(M, 4) uint8 linear RGBA of (M, 3) uint8 sRGB: glTF 2.0 keeps vertex colours in linear
    light.
    """
    linear = to_8bit(srgb_to_linear(colours / np.float32(255)))
    return np.column_stack([linear, np.full(len(colours), 255, np.uint8)])
