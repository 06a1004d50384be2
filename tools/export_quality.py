"""What the mesh of a run on demo loses: python tools/export_quality.py RUN."""

import argparse
import json
import sys
from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from pp_cl.engine.grid import Grid
from pp_cl.errors import UserError
from pp_cl.run import Run, load
from pp_cl.scene.demo import demo_mesh, distances
from pp_studio.export.mesh import HIDDEN, box_around, fuse

SAMPLES = 60_000  # of a surface
EXACT = Grid((-1.3, -1.3, -1.3), 0.01, (261, 261, 261))  # where exact distances are asked for


def mesh_rows(run: Run) -> list[dict]:
    """Distances of meshes to the exact surface and back, in voxel sizes."""
    cameras = run.cameras("train")
    views = [(camera, run.render(camera)) for camera in cameras]
    means = [(camera, replace(p, median_depth=p.depth)) for camera, p in views]
    grid = box_around(run.model.grid, run.model.cloud.ids.get())
    opacity = _opacities(run, grid)
    exact = distances(run.dev, EXACT), cKDTree(demo_mesh(run.dev)[0])
    fields = [(f"opacity, level {level}", level - opacity) for level in (0.3, 0.5, 0.7)]
    fields += [
        ("fused median depths, hidden vertices say nothing", fuse(grid, views, 0.0)),
        (f"fused mean depths, hidden {HIDDEN}", fuse(grid, means)),
        (f"fused median depths, hidden {HIDDEN}, as exported", fuse(grid, views)),
    ]
    return [{"field": name} | _measured(field, grid, *exact) for name, field in fields]


def _opacities(run, grid):
    """(nz, ny, nx) opacities on a grid, 0 where there is no point."""
    dense = np.zeros(grid.dims[::-1], np.float32)
    positions = run.model.positions()
    i, j, k = np.rint((positions - np.asarray(grid.origin)) / grid.voxel_size).astype(int).T
    dense[k, j, i] = run.model.cloud.opacity.get()[:, 0]
    return dense


def _measured(field, grid, exact, surface):
    """A row of the surface where a field is 0, positive outside. surface: tree of exact points."""
    vertices, faces, _, _ = marching_cubes(field, 0, gradient_direction="ascent")
    corners = (np.asarray(grid.origin) + grid.voxel_size * vertices[:, ::-1])[faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(faces), SAMPLES, p=area / area.sum())
    points = (rng.dirichlet((1, 1, 1), SAMPLES)[..., None] * corners[chosen]).sum(1)
    at = (points - np.asarray(EXACT.origin)) / EXACT.voxel_size
    away = np.abs(map_coordinates(exact, at[:, ::-1].T, order=1, mode="nearest")) / grid.voxel_size
    back = cKDTree(points).query(surface.data)[0] / grid.voxel_size
    return {
        "mean": round(float(away.mean()), 2),
        "median": round(float(np.median(away)), 2),
        "back": round(float(back.mean()), 2),
        "vertices": len(vertices),
    }


def main() -> int:
    """Print the rows; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="folder of a run on demo")
    parser.add_argument("--json", metavar="FILE", help="write them there too")
    options = parser.parse_args()
    try:
        run = load(options.run)
        if run.config.scene.path != "demo":
            raise UserError(f"{options.run}: its scene is {run.config.scene.path}, not demo")
    except UserError as error:
        print(f"export_quality: {error}", file=sys.stderr)
        return 2
    result = {"mesh": mesh_rows(run)}
    for row in result["mesh"]:
        print(row)
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(result, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
