"""The command pp-cl shape."""

import argparse
import math

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
    add("--edge", metavar="E", help="of a mesh: the grid's edge in its units (default: 2^27 cells)")
    add("--samples", metavar="N", default=str(SAMPLES), help="on the mesh (1024^3)")
    add("--scene", metavar="SCENE", help="where the run's scene is now, if it has moved")
    add("--json", metavar="FILE", help="also write the numbers there")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print the row. Raises UserError for options that do not fit the subject."""
    from pp_cl.device.discover import open_device
    from pp_cl.files.atomic import write_json
    from pp_cl.files.run_folder import RunFolder
    from pp_cl.metrics.shape import read_mesh
    from pp_cl.shape import mesh_shape, run_shape

    samples, folder = _samples(options.samples), RunFolder(options.subject)
    is_run = folder.path.is_dir()
    for given, name, of_run in (
        (options.mesh, "mesh", True),
        (options.scene, "scene", True),
        (options.edge, "edge", False),
    ):
        if given is not None and of_run != is_run:
            raise UserError(f"--{name}: only of a {'run' if of_run else 'mesh'}; leave it out")
    edge = None if options.edge is None else _edge(options.edge)
    mesh = options.mesh if is_run else options.subject
    mesh = None if mesh is None else read_mesh(mesh)
    dev = open_device(options.device)
    if is_run:
        facts = run_shape(dev, folder, mesh, samples, scene=options.scene)
    else:
        facts = mesh_shape(dev, mesh, edge, samples)
    if options.json:
        write_json(options.json, facts)
    print("\n".join(_lines(facts)))


def _samples(text):
    if not 1 <= shared.whole(text) <= SAMPLES:
        raise UserError(f"--samples {text}: must be a whole number from 1 to {SAMPLES}")
    return shared.whole(text)


def _edge(text):
    try:
        edge = float(text)
    except ValueError:
        edge = math.nan
    if not 0 < edge < math.inf:
        raise UserError(f"--edge {text}: must be a number above 0")
    return edge


def _lines(facts):
    grid = facts["grid"]
    lines = [
        f"grid      {'x'.join(map(str, grid['dims']))}, edge {grid['edge']:.6g}",
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
