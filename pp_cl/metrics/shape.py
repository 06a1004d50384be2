"""Measures how well points fill a mesh's surface (PlenopticPoints supplemental, Table 4)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.errors import UserError
from pp_cl.files.untrusted import refusal

SAMPLES = 1024**3  # as in the supplemental
RUN = 256  # samples per work-item
LAUNCH = 2**24  # samples per launch
WHOLE_AREA = 1 << 60
MOST_FILE = 2**28  # bytes of a mesh file; trimesh takes up to 11 bytes of memory for each
MOST_VERTICES = 2**33  # in the grid around mesh and points: a bitset of 1 GiB


@dataclass(frozen=True)
class Mesh:
    """vertices: (V, 3) float64, world coordinates. faces: (F, 3) integers."""

    vertices: np.ndarray
    faces: np.ndarray


def read_mesh(path: Path | str) -> Mesh:
    """The triangles of all objects in a file that trimesh can read. Raises UserError."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a triangle mesh")
    if path.stat().st_size > MOST_FILE:
        raise UserError(f"{path}: is larger than {MOST_FILE} bytes; save it as PLY, or decimate it")
    try:
        # the warnings concern numbers that are refused below
        with np.errstate(all="ignore"):
            mesh: Any = trimesh.load(path, force="mesh", process=False)
            made = Mesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))
    except Exception as error:  # loaders raise all kinds of exceptions on broken files
        raise refusal(path, error, "a mesh") from error
    if made.faces.size == 0 or not made.vertices.shape[1:] == made.faces.shape[1:] == (3,):
        raise UserError(f"{path}: holds no triangles; export it as a triangle mesh")
    if made.faces.min() < 0 or made.faces.max() >= len(made.vertices):
        raise UserError(f"{path}: a face names a missing vertex; export it again")
    if not np.isfinite(made.vertices).all():
        raise UserError(f"{path}: a vertex is NaN or infinite; export it again")
    return made


@dataclass(frozen=True)
class Surface:
    """The vertices of a grid that are nearest to some point of a mesh. grid: the given grid,
    extended to hold the mesh. bits: (ny nz, words) uint32: bit b of word w in a row is vertex 32 w
    + b. count: number of vertices.
    """

    grid: Grid
    bits: np.ndarray
    count: int

    def holds(self, grid: Grid, ids: np.ndarray) -> np.ndarray:
        """(N,) bool: which of the given grid's vertices, by ids (N,), belong to the surface."""
        steps = np.rint(np.subtract(grid.origin, self.grid.origin) / grid.voxel_size).astype(
            np.int64
        )
        i, j, k = (grid.coordinates(ids) + steps).T
        words = self.bits[k * self.grid.dims[1] + j, i // 32]
        return (words >> (i % 32).astype(np.uint32) & 1).astype(bool)


def overlap(surface: Surface, grid: Grid, ids: np.ndarray) -> dict[str, float]:
    """{"points", "iou", "recall", "precision"} of the points with ids (N,), N > 0, compared with
    the surface's vertices, on the grid for which the surface was sampled.
    """
    shared, points = int(surface.holds(grid, ids).sum()), len(ids)
    return {
        "points": points,
        "iou": shared / (surface.count + points - shared),
        "recall": shared / surface.count,
        "precision": shared / points,
    }


def sample_surface(
    dev: Device,
    mesh: Mesh,
    grid: Grid,
    samples: int = SAMPLES,
    *,
    advance: Callable[[int], object] = lambda samples: None,
) -> Surface:
    """The Surface of a mesh for a grid, from 1 to SAMPLES samples spread evenly over the mesh's
    area; advance(n) is called after every n samples. Raises UserError for a mesh without area or
    too large.
    """
    around = _grid_around(mesh, grid)
    area_end, corners = _triangles(mesh, around)
    nx, ny, nz = around.dims
    rows, words = ny * nz, -(-nx // 32)
    bits = dev.zeros((rows, words), np.uint32)
    program = dev.program("metrics/shape", RUN=RUN)
    area_end_device, corners_device = dev.upload(area_end), dev.upload(corners)
    for first in range(0, samples, LAUNCH):
        count = min(LAUNCH, samples - first)
        program.launch(
            "sample_surface",
            -(-count // RUN),
            samples=samples,
            first=first,
            count=count,
            triangles=len(area_end),
            nx=nx,
            ny=ny,
            nz=nz,
            words=words,
            bits=bits,
            area_end=area_end_device,
            corners=corners_device,
        )
        dev.finish()
        advance(count)
    marked = bits.get()
    parts = np.array_split(marked, -(-marked.size // 2**20))  # a bit takes a byte for a moment
    return Surface(around, marked, sum(int(np.unpackbits(p.view(np.uint8)).sum()) for p in parts))


def _grid_around(mesh, grid):
    """A grid, extended by whole voxels to hold the mesh, too. Raises UserError."""
    origin = np.asarray(grid.origin)
    low = np.floor((mesh.vertices.min(0) - origin) / grid.voxel_size)
    high = np.ceil((mesh.vertices.max(0) - origin) / grid.voxel_size)
    low, high = np.minimum(low, 0), np.maximum(high, np.asarray(grid.dims) - 1)
    dims = tuple(int(n) for n in high - low + 1)
    if math.prod(dims) > MOST_VERTICES:
        raise UserError(
            f"the mesh reaches over {dims[0]}x{dims[1]}x{dims[2]} vertices of the grid, more than"
            f" {MOST_VERTICES}: is it in the world of the scene?"
        )
    return Grid(tuple(float(x) for x in origin + low * grid.voxel_size), grid.voxel_size, dims)


def _triangles(mesh, grid):
    """(area_end (F,) uint64, corners (F, 3, 4) float32) of the triangles that have an area."""
    corners = (mesh.vertices[mesh.faces] - np.asarray(grid.origin)) / grid.voxel_size
    sides = corners[:, 1:] - corners[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    has_area = areas > 0
    if not has_area.any():
        raise UserError("the mesh has no triangle with an area")
    share = np.cumsum(areas[has_area]) / areas[has_area].sum()
    area_end = np.minimum(share * WHOLE_AREA, WHOLE_AREA).astype(np.uint64)
    return area_end, np.pad(corners[has_area], ((0, 0), (0, 0), (0, 1))).astype(np.float32)
