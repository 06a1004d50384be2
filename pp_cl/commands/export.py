"""`pp-cl export`: writes a run in a format that other programs open."""

import argparse
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError
from pp_cl.export import FORMATS, WINDOW

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
        "--window",
        type=shared.integer(16, 16384),
        metavar="PIXELS",
        help="splats: fit the Gaussians for pictures of so many pixels on the longer side"
        f" ({WINDOW}); up to 12 times those of the training images",
    )
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Write the run, say what was written."""
    from pp_cl.device.discover import open_device
    from pp_cl.export.formats import check_target, export
    from pp_cl.run import load_run

    name, folder = options.format, Path(options.run_folders[0])
    if name not in OF_POINTS:
        shared.refuse(options, ("min_weight",), f"only {' and '.join(OF_POINTS)} leave out points")
    if name not in OF_SPLATS:
        shared.refuse(options, ("window",), f"only {', '.join(OF_SPLATS)} are fitted to a window")
    if name != "gallery" and len(options.run_folders) > 1:
        raise UserError(f"RUN {options.run_folders[1]}: only a gallery has several runs; name one")
    path = check_target(name, folder, Path(options.out) if options.out else None)
    device = open_device(options.device)

    def loaded(folder):
        run = load_run(device, folder, scene=options.scene)
        if not run.header["finished"]:
            print(
                f"{folder}: unfinished, step {run.header['step']} of"
                f" {run.config.train.iterations}; its last checkpoint is exported"
            )
        return run

    run, *others = options.run_folders
    written = export(
        loaded(run),
        name,
        path,
        min_weight=options.min_weight or 0.0,
        window=options.window or WINDOW,
        others=map(loaded, others),
    )
    print(f"wrote {path}: {written}")
