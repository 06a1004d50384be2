"""`pp-cl shape`: measures how well the points of a run fill the surface of a mesh."""

import argparse

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "measure how well a run's points fill the surface of a mesh"
EPILOG = """The mesh is sampled evenly by its area, each sample goes to the grid's nearest vertex;
these vertices are compared with the points before and after training (Table 4 of the supplemental).
Without a run: the number of vertices of a grid with --edge."""
SAMPLES = 1024**3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("subject", metavar="RUN|MESH", help="folder of a run, or a file with a triangle mesh")
    add(
        "--mesh",
        metavar="FILE",
        help="of a run: the object's mesh in the scene's world; the demo has its own",
    )
    add(
        "--edge",
        type=shared.number(1e-30, 1e30),
        metavar="E",
        help="of a mesh: voxel size of the grid in its units (default: 2^27 cells)",
    )
    add(
        "--samples",
        type=shared.integer(1, SAMPLES),
        metavar="N",
        default=SAMPLES,
        help="on the mesh (1024^3)",
    )
    shared.add_run_scene(parser)
    shared.add_json(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print the row. Raises UserError for options that do not fit the subject."""
    from pp_cl.commands.shape_facts import mesh_shape, run_shape
    from pp_cl.config import nearby_run
    from pp_cl.device.discover import open_device
    from pp_cl.files.run_folder import RunFolder
    from pp_cl.metrics.shape import read_mesh

    folder = RunFolder(options.subject)
    is_run = folder.path.is_dir()
    if not folder.path.exists():
        near = nearby_run(folder.path)
        raise UserError(f"{folder}: no such file or folder; {near or 'name a run or a mesh'}")
    if is_run:
        shared.refuse(options, ("edge",), "only of a mesh")
        mesh, dev = read_mesh(options.mesh) if options.mesh else None, open_device(options.device)
        facts = run_shape(dev, folder, mesh, options.samples, scene=options.scene)
    else:
        shared.refuse(options, ("mesh", "scene"), "only of a run")
        mesh, dev = read_mesh(options.subject), open_device(options.device)
        facts = mesh_shape(dev, mesh, options.edge, options.samples)
    shared.tell(options.json, facts, _lines(facts))


def _lines(facts):
    grid = facts["grid"]
    lines = [
        f"grid      {'x'.join(map(str, grid['dims']))}, voxel size {grid['edge']:.6g}",
        f"surface   {facts['surface']} vertices, by {facts['samples']} samples",
    ]
    if "before" in facts:
        lines.append("training      points       IoU    recall precision")
    for when in ("before", "after"):
        if when in facts:
            row = facts[when]
            values = "  ".join(f"{row[name]:8.4f}" for name in ("iou", "recall", "precision"))
            lines.append(f"{when:8s}  {row['points']:10d}  {values}")
    return lines
