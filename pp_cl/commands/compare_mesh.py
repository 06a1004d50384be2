"""How well a run's points fill the surface of a mesh: a row of the supplemental's Table 4."""

from typing import Any

import numpy as np

from pp_cl.checkpoint import opened_run
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid, smallest_voxel_size
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.shape import Mesh, overlap, sample_surface
from pp_cl.progress import Progress
from pp_cl.run import check_scene, stored_config
from pp_cl.scene.demo import demo_mesh
from pp_cl.scene.hull import CELL_CAP, agreeing, hull_on
from pp_cl.scene.listing import DEMO, scene_box
from pp_cl.scene.load import open_scene
from pp_cl.settings import Config

DEMO_RESOLUTION = 512  # vertices of the demo's mesh along its longest side


def mesh_shape(dev: Device, mesh: Mesh, voxel_size: float | None, samples: int) -> dict[str, Any]:
    """{"grid": {"dims", "voxel_size"}, "samples", "surface": vertices nearest to the mesh} for a
    grid of this voxel size around the mesh; None: the smallest that points may have.
    """
    box = np.stack([mesh.vertices.min(0), mesh.vertices.max(0)])
    chosen = voxel_size or smallest_voxel_size(box, CELL_CAP)
    surface, facts = _sampled(dev, mesh, Grid.centred_in(box, chosen), samples)
    return facts | {"grid": _grid_facts(surface.grid)}


def _sampled(dev, mesh, grid, samples):
    """(sample_surface() under a progress bar, facts about it)."""
    with Progress("sampling", samples, "sample") as bar:
        surface = sample_surface(dev, mesh, grid, samples, advance=bar.update)
    return surface, {"grid": _grid_facts(grid), "samples": samples, "surface": surface.count}


def _grid_facts(grid):
    return {"dims": list(grid.dims), "voxel_size": grid.voxel_size}


def run_shape(
    dev: Device, folder: RunFolder, mesh: Mesh | None, samples: int, *, scene: str | None = None
) -> dict[str, Any]:
    """The facts of mesh_shape() for a run's last grid, and overlap() with the points "before"
    training, which fill the hull, and "after" it. mesh: in the scene's world; None: the demo's own.
    scene: where it is now. Raises UserError for a checkpoint, a scene or a mesh that is missing.
    """
    config = stored_config(folder, scene)
    check_scene(config.scene.path)
    if mesh is None:
        if config.scene.path != DEMO:
            raise UserError(f"{folder}: which mesh? give it with --mesh FILE, in the scene's world")
        mesh = Mesh(*demo_mesh(dev, DEMO_RESOLUTION))
    with opened_run(folder, config) as stored:
        grid, after = Grid.of_header(stored.header["grid"]), stored.array("points.ids")
        count = stored.header["initial_points"]
    before = _points_before(dev, config, grid, count)
    surface, facts = _sampled(dev, mesh, grid, samples)
    return facts | {
        "before": overlap(surface, grid, before),
        "after": overlap(surface, grid, after),
    }


def _points_before(dev, config: Config, grid, count):
    """Ids on a run's last grid of the `count` points that it began with, after refinements."""
    views = open_scene(dev, config, ("train",)).splits["train"]
    agreement = agreeing(dev, views, scene_box(config))
    grids = [grid]
    for _ in config.train.refine_at:
        if not any(n % 2 for n in grids[-1].dims):  # a refined grid has even sides
            grids.append(grids[-1].coarsened())
    while grids:  # coarsest first, as it is the quickest; the run began on one of these
        first = grids.pop()
        ids = hull_on(dev, agreement.views, first, agreement.forgiven)
        if len(ids) == count:
            for _ in grids:
                ids, _ = first.children(ids)
                first = first.refined()
            return ids
    raise UserError(
        f"{config.scene.path}: its hull is not the one that the run began with; say where the"
        " scene is with --scene"
    )
