"""Points and meshes as files of trimesh."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from pp_cl.export.points import ColouredPoints
from pp_cl.files.atomic import atomic_file
from pp_cl.files.exr import srgb_to_linear
from pp_cl.files.image import to_8bit


def write_point_glb(path: Path | str, points: ColouredPoints) -> None:
    """Write a GLB file of coloured points. Raises UserError as atomic_file does."""
    colours = gltf_colours(points.colours)
    data = glb_data(points.positions, lambda positions: trimesh.PointCloud(positions, colours))
    with atomic_file(path) as file:
        file.write(data)


def glb_data(
    positions: np.ndarray, make: Callable[[np.ndarray], trimesh.parent.Geometry3D]
) -> bytes:
    """The GLB file of what make() makes of (M, 3) positions. glTF 2.0 keeps these in float32, so
    those of float64 are moved to the origin, and the file's node moves them back.
    """
    if positions.dtype == np.float32:
        return make(positions).export(file_type="glb")
    centre = np.rint(positions.mean(0))
    scene, place = trimesh.Scene(), np.eye(4)
    place[:3, 3] = centre
    scene.add_geometry(make(positions - centre), transform=place)
    return scene.export(file_type="glb")


def gltf_colours(colours: np.ndarray) -> np.ndarray:
    """(M, 4) uint8 linear RGBA of (M, 3) uint8 sRGB: glTF 2.0 keeps vertex colours in linear
    light.
    """
    linear = to_8bit(srgb_to_linear(colours / np.float32(255)))
    return np.column_stack([linear, np.full(len(colours), 255, np.uint8)])
