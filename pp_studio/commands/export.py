"""`pp-cl export`: writes a run in a format that other programs open."""

import argparse
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.config import load_config
from pp_cl.errors import UserError
from pp_studio.export import AXES, AXES_OF, FORMATS, QUALITIES, QUICK

HELP = "write a run in a format that other programs open"
EPILOG = "\n".join(
    (
        "formats:",
        *(f"  {name:9}  {what}" for name, (_, _, what) in FORMATS.items()),
        "docs/export.md says more.",
    )
)
OF_POINTS, OF_SPLATS = ("ply", "glb"), ("splat", "splat-spz", "splat-glb")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folders", metavar="RUN", nargs="+", help="folder of the run; several for a gallery")
    add("--format", required=True, choices=FORMATS, help="see below")
    add(
        "--out",
        metavar="PATH",
        help="file, or folder of scene and gallery (default: in RUN/export)",
    )
    add(
        "--min-weight",
        type=shared.number(0, 1e6),
        metavar="W",
        help="ply, glb: leave out points whose blend weights add up to at most W in every training"
        " view (0: points that no view shows)",
    )
    add(
        "--quality",
        choices=QUALITIES,
        help=f"splats: how long the Gaussians are fitted ({QUICK}: a minute or two; best: some ten"
        " times as long)",
    )
    add(
        "--length",
        nargs=3,
        metavar=("A", "B", "METRES"),
        help="how far apart two points of the object are, each as PHOTO:X,Y, a pixel of a training"
        " photograph; kept in RUN/length.json: splats, points and meshes are in metres then",
    )
    add(
        "--box",
        type=shared.box,
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="splats, points and meshes: only what lies in it, in the units and axes of the scene;"
        " write --box=-1,-1,...",
    )
    add(
        "--axes",
        choices=AXES,
        help="the scene's, or turned so that the object stands upright in viewers (splats,"
        " textured: viewer; points, mesh: scene)",
    )
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace, *, kept: bool = False) -> None:
    """Write the run, and print what was written. kept: a splat is of the Gaussians that are kept,
    however few steps they were fitted in.
    """
    from pp_cl import find_run, load, open_device
    from pp_studio.export.formats import check_target, export_run
    from pp_studio.export.length import set_length

    name, folders = options.format, [find_run(run_folder) for run_folder in options.run_folders]
    if name not in OF_POINTS:
        shared.refuse(options, ("min_weight",), f"only {' and '.join(OF_POINTS)} leave out points")
    if name not in OF_SPLATS:
        shared.refuse(options, ("quality",), f"only {', '.join(OF_SPLATS)} are fitted")
    if name not in AXES_OF:
        shared.refuse(options, ("box", "axes"), f"only {', '.join(AXES_OF)} hold coordinates")
    if name != "gallery" and len(options.run_folders) > 1:
        raise UserError(f"RUN {options.run_folders[1]}: only a gallery has several runs; name one")
    ends = (*options.length[:2], _metres(options.length[2])) if options.length else None
    path = check_target(name, folders[0].path, Path(options.out) if options.out else None)
    for run_folder in folders:
        load_config(run_folder.config)  # check that all runs are there before any work
    device = open_device(options.device)

    def loaded(folder):
        run = load(folder.path, device, scene=options.scene)
        if not run.header["finished"]:
            print(
                f"{folder}: unfinished, step {run.header['step']} of"
                f" {run.config.train.iterations}; its last checkpoint is exported"
            )
        return run

    first, *others = folders
    run = loaded(first)
    if ends:
        unit = set_length(run, *ends)
        print(f"a unit of the scene is {unit:.6g} m")
    written = export_run(
        run,
        name,
        path,
        min_weight=options.min_weight or 0.0,
        quality=options.quality or (None if kept else QUICK),
        box=options.box,
        axes=options.axes,
        others=map(loaded, others),
    )
    print(f"wrote {path}: {written}")


def _metres(text):
    try:
        return shared.number(1e-6, 1e6)(text)
    except UserError as error:
        raise UserError(f"--length {error}, in metres") from None
