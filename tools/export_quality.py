"""Measure the mesh of a run: python tools/export_quality.py RUN.

Prints the number of faces and the share of them that no view shows; the number of parts; the Euler
number, 2 for one part without holes; and the roughness, the mean angle between neighbouring faces.
For demo, whose surface is known, also the mean distances in voxel sizes, from mesh to surface and
back.
"""

import argparse
import json
import sys

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from pp_cl.engine.grid import Grid
from pp_cl.errors import UserError
from pp_cl.run import Run, load
from pp_cl.scene.demo import demo_mesh, distances
from pp_studio.export.mesh import seen_first, surface

SAMPLES = 60_000  # points on the mesh
EXACT = Grid((-1.3, -1.3, -1.3), 0.01, (261, 261, 261))  # where exact distances are computed


def mesh_figures(run: Run) -> dict:
    """The figures of the exported mesh; distances only if the run is on demo."""
    geometry = surface(run)
    solid = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
    figures = {
        "faces": len(geometry.faces),
        "guessed": round(1 - seen_first(geometry.faces, geometry.seen)[1] / len(geometry.faces), 3),
        "parts": int(solid.body_count),
        "euler": int(solid.euler_number),
        "roughness": round(float(np.degrees(solid.face_adjacency_angles).mean()), 1),
    }
    return figures | (_distances(run, solid) if run.config.scene.path == "demo" else {})


def _distances(run, solid):
    points, _ = trimesh.sample.sample_surface(solid, SAMPLES, seed=0)
    at = (points - np.asarray(EXACT.origin)) / EXACT.voxel_size
    away = map_coordinates(distances(run.dev, EXACT), at[:, ::-1].T, order=1, mode="nearest")
    back, _ = cKDTree(points).query(demo_mesh(run.dev)[0])
    both = {"mean": np.abs(away).mean(), "median": np.median(np.abs(away)), "back": back.mean()}
    return {name: round(float(gap) / run.model.grid.voxel_size, 2) for name, gap in both.items()}


def main() -> int:
    """Print the figures; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("run", help="folder of a run")
    parser.add_argument("--json", metavar="FILE", help="write them there too")
    options = parser.parse_args()
    try:
        figures = mesh_figures(load(options.run))
    except UserError as error:
        print(f"export_quality: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures))
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(figures, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
