"""Writes the points of a run, in the colours that its network gives them, as PLY files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile

from pp_cl import Run
from pp_cl.engine import PointCloud
from pp_cl.errors import UserError
from pp_cl.files import atomic_file, to_8bit
from pp_studio.export.harmonics import observe

COMMENTS = (
    "red, green, blue: sRGB, as the run shows the point in the training view where it weighs most",
    "weight: blend weights of the point in that view, summed over its pixels",
    "point_opacity: of its centre, 0 to 1",
    "radius: where its opacity has fallen to 0",
    "feature_C_D_K: coefficient K of degree D of the spherical harmonics of feature C, C from 0 to",
    "15; basis and signs of PlenOctrees, in the axes of the scene whatever those of x, y, z are;",
    "features are the input of the run's network, no colours",
)
COORDINATES, CHANNELS = ("x", "y", "z"), ("red", "green", "blue")
FINEST = 1e-3  # how far, in voxel sizes, rounding to float32 may move a point in a file


@dataclass(frozen=True)
class ColouredPoints:
    """M points in the order of their ids.

    rows: (M,) int64, their rows in the run's point cloud. positions: (M, 3) as in_world() gives
    them. colours: (M, 3) uint8 sRGB. weight: (M,) float32, the blend weights in the view that gave
    the colour, summed over its pixels. opacity: (M,) float32. radius: (M,) float32, world units.
    """

    rows: np.ndarray
    positions: np.ndarray
    colours: np.ndarray
    weight: np.ndarray
    opacity: np.ndarray
    radius: np.ndarray


def coloured_points(
    run: Run, min_weight: float = 0.0, box: np.ndarray | None = None
) -> ColouredPoints:
    """The points that weigh more than min_weight in some training view. A point's colour comes from
    the view where it weighs most, at the pixel that shows its centre, without the background.

    Points that no training view shows are left out: no colour is invented for them. box: (2, 3) to
    which points are limited, or None. Raises UserError if no point is left.
    """
    cloud, voxel_size = run.model.cloud, run.model.grid.voxel_size
    positions = run.model.positions()
    colours, best = np.zeros((cloud.count, 3), np.uint8), np.zeros(cloud.count, np.float32)
    for observation in observe(run, run.cameras("train"), "colours"):
        weights = observation.point_weights()
        higher, camera = np.flatnonzero(weights > best), observation.camera
        best[higher] = weights[higher]
        # a centre just outside the image takes the nearest pixel; its depth is above 0
        column, row, _ = camera.project(positions[higher])
        column = column.clip(0, camera.width - 1).astype(np.int64)
        row = row.clip(0, camera.height - 1).astype(np.int64)
        colours[higher] = to_8bit(run.render(camera).rgba()[row, column, :3])
    rows = np.flatnonzero(best > min_weight)
    if not len(rows):
        raise UserError(
            f"--min-weight {min_weight:g}: no point weighs more in any training view (at most "
            f"{best.max(initial=0):.3g}); lower it"
        )
    rows = rows[inside(positions[rows], box)]
    return ColouredPoints(
        rows,
        in_world(positions[rows], voxel_size),
        colours[rows],
        best[rows],
        cloud.opacity.get()[rows, 0],
        run.renderer.point_radius * np.exp(cloud.offset.get()[rows, 3]),
    )


def inside(positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
    """(N,) bool: which positions (N, 3) lie in a box (2, 3) of the world; all if box is None.
    Raises UserError if none does.
    """
    if box is None:
        return np.ones(len(positions), bool)
    is_inside = ((positions >= box[0]) & (positions <= box[1])).all(1)
    if not is_inside.any():
        ends = (positions.min(0), positions.max(0))
        low, high = (",".join(f"{x:.3g}" for x in corner) for corner in ends)
        raise UserError(f"--box: nothing lies in it; the run reaches from {low} to {high}")
    return is_inside


def in_world(positions: np.ndarray, voxel_size: float) -> np.ndarray:
    """(N, 3) float64 world positions as files store them: float32, which every program reads, or
    float64 if the world's origin is so far away that float32 moves them. voxel_size: the grid's.
    """
    resolution = np.spacing(np.float32(np.abs(positions).max(initial=0)))
    return positions if resolution > FINEST * voxel_size else positions.astype(np.float32)


def write_ply(
    path: Path | str, points: ColouredPoints, cloud: PointCloud, frame: str = "its scene's"
) -> None:
    """Write points, and what `cloud` learned about them, as write_vertices() does. frame: whose
    axes and units the positions have, in words.
    """
    columns = place_and_colour(points.positions, points.colours)
    columns |= {"point_opacity": points.opacity, "weight": points.weight, "radius": points.radius}
    for block, array in zip(cloud.blocks, cloud.sh, strict=True):
        values = array.get()[points.rows].astype(np.float32)
        for k in range(block.count):
            order = block.first + k - block.degree**2  # index within its degree
            columns |= {f"feature_{c}_{block.degree}_{order}": values[:, k, c] for c in range(16)}
    about = (f"pp-cl: points of a run; axes and units: {frame}", *COMMENTS)
    write_vertices(path, columns, comments=about)


def write_vertices(
    path: Path | str,
    columns: dict[str, np.ndarray],
    faces: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY file of vertices, {property: (M,) array}, and of faces
    (F, 3) if there are any. Raises UserError as atomic_file does.
    """
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    vertices = np.rec.fromarrays(list(columns.values()), dtype=kinds)
    elements = [plyfile.PlyElement.describe(vertices, "vertex")]
    if faces is not None:
        triangles = np.empty(len(faces), [("vertex_indices", "<i4", (3,))])
        triangles["vertex_indices"] = faces
        elements.append(plyfile.PlyElement.describe(triangles, "face"))
    with atomic_file(path) as file:
        plyfile.PlyData(elements, byte_order="<", comments=list(comments)).write(file)


def place_and_colour(positions: np.ndarray, colours: np.ndarray) -> dict[str, np.ndarray]:
    """{property of a PLY vertex: (M,) array} from positions and colours, both (M, 3)."""
    columns = dict(zip(COORDINATES, positions.T, strict=True))
    return columns | dict(zip(CHANNELS, colours.T, strict=True))
