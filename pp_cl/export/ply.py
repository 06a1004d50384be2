"""Points as a PLY file with everything that is learned of them."""

from pathlib import Path

import numpy as np
import plyfile

from pp_cl.export.points import ColouredPoints
from pp_cl.files.atomic import atomic_file
from pp_cl.raster.points import PointCloud

COMMENTS = (
    "pp-cl: points of a run, world axes and units of its scene",
    "red, green, blue: sRGB, as the run shows the point in the training view where it weighs most",
    "weight: blend weights of the point in that view, summed over its pixels",
    "opacity: of the point's centre, 0 to 1",
    "feature_C_D_K: coefficient K of degree D of the spherical harmonics of feature C, C from 0 to",
    "15; basis and signs of PlenOctrees; features are the input of the run's network, no colours",
)
COORDINATES, CHANNELS = ("x", "y", "z"), ("red", "green", "blue")


def write_ply(path: Path | str, points: ColouredPoints, cloud: PointCloud) -> None:
    """Write a binary little-endian PLY file of points and of what `cloud` learned of them. Raises
    UserError as atomic_file does.
    """
    columns = _columns(points) | _harmonics(points, cloud)
    dtype = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    table = np.empty(len(points.rows), dtype)
    for name, column in columns.items():
        table[name] = column
    element = plyfile.PlyElement.describe(table, "vertex")
    data = plyfile.PlyData([element], byte_order="<", comments=list(COMMENTS))
    with atomic_file(path) as file:
        data.write(file)


def _columns(points):
    """{property: (M,) array} of what every program understands."""
    columns = dict(zip(COORDINATES, points.positions.T, strict=True))
    columns |= dict(zip(CHANNELS, points.colours.T, strict=True))
    return columns | {"opacity": points.opacity, "weight": points.weight}


def _harmonics(points, cloud):
    """{property: (M,) array} of the SH coefficients."""
    columns = {}
    for block, array in zip(cloud.blocks, cloud.sh, strict=True):
        values = np.float32(array.get()[points.rows])
        for k in range(block.count):
            order = block.first + k - block.degree**2  # within its degree
            named = {f"feature_{c}_{block.degree}_{order}": values[:, k, c] for c in range(16)}
            columns |= named
    return columns
