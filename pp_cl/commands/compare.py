"""`pp-cl compare`: compares images with the ground truth, or a run's points with a mesh."""

import argparse
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "measure images against the truth, or a run's points against a mesh"
EPILOG = """With TRUTH: --metrics of one image, or of each image of a folder.
Without TRUTH: how well a run's points fill the surface of a mesh, before and after training (Table
4 of the supplemental). The mesh is sampled evenly by its area, and each sample goes to the grid's
nearest vertex; these vertices are compared with the points. Of a mesh alone: their number, on a
grid with --edge."""
METRICS = ("psnr", "ssim")
SAMPLES = 1024**3  # as in pp_cl.metrics.shape


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add(
        "subject",
        metavar="PRED|RUN|MESH",
        help="image, or folder of images; folder of a run, or a file with a triangle mesh",
    )
    add("truth", nargs="?", metavar="TRUTH", help="with PRED: the true image, or folder of images")
    shared.add_metrics(parser)
    parser.set_defaults(metrics=None)
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
    samples = shared.integer(1, SAMPLES)
    add("--samples", type=samples, metavar="N", help="points on the mesh (1024^3)")
    shared.add_run_scene(parser)
    shared.add_json(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Measure, print. Raises UserError for options that do not fit the subject."""
    if options.truth is None:
        shared.refuse(options, ("metrics",), "only of images, with TRUTH")
        facts = _shape(options)
        shared.tell(options.json, facts, _rows(facts))
    else:
        shared.refuse(options, ("mesh", "edge", "samples", "scene"), "only without TRUTH")
        result = _images(options)
        lines = [f"{name:6s} {value:.4f}" for name, value in result["mean"].items()]
        shared.tell(options.json, result, lines)


def _images(options):
    from pp_cl.drivers import open_device
    from pp_cl.metrics.compare import compare

    metrics = options.metrics or METRICS
    dev = open_device(options.device) if "lpips" in metrics else None
    return compare(options.subject, options.truth, metrics, dev)


def _shape(options):
    from pp_cl.commands.compare_mesh import mesh_shape, run_shape
    from pp_cl.config import nearby_run
    from pp_cl.drivers import open_device
    from pp_cl.metrics.shape import read_mesh
    from pp_cl.run import find_run

    path, samples = Path(options.subject), options.samples or SAMPLES
    if not path.exists():
        near = nearby_run(path)
        raise UserError(f"{path}: no such file or folder; {near or 'name a run or a mesh'}")
    if path.is_dir():
        shared.refuse(options, ("edge",), "only of a mesh")
        mesh, dev = read_mesh(options.mesh) if options.mesh else None, open_device(options.device)
        return run_shape(dev, find_run(path), mesh, samples, scene=options.scene)
    shared.refuse(options, ("mesh", "scene"), "only of a run")
    mesh, dev = read_mesh(path), open_device(options.device)
    return mesh_shape(dev, mesh, options.edge, samples)


def _rows(facts):
    grid = facts["grid"]
    lines = [
        f"grid      {'x'.join(map(str, grid['dims']))}, voxel size {grid['voxel_size']:.6g}",
        f"surface   {facts['surface']} vertices, by {facts['samples']} samples",
    ]
    if "before" in facts:
        lines.append("training      points       IoU    recall precision")
        for when in ("before", "after"):
            row = facts[when]
            values = "  ".join(f"{row[name]:8.4f}" for name in ("iou", "recall", "precision"))
            lines.append(f"{when:8s}  {row['points']:10d}  {values}")
    return lines
