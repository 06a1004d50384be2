"""`pp-cl capture`: makes a scene with cameras, box and masks from photographs or a video."""

import argparse
from typing import Any

from pp_cl.commands import options as shared
from pp_studio.capture import STAGES

HELP = "make a scene from photographs or a video: cameras, box and masks"
EPILOG = "\n".join(
    (
        "stages, each done once; the same command goes on where it stopped:",
        *(f"  {stage:10}  {what}" for stage, what in STAGES.items()),
        "",
        "--turntable, --masks, --mask-command and --box are kept in SCENE/capture/options.json for",
        "the next command, until others are given; --no-turntable, and the word auto, undo them.",
    )
)
AUTO = "auto"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("source", metavar="INPUT", help="folder of photographs, or a video")
    add("--out", required=True, metavar="SCENE", help="folder of the scene")
    add("--from", dest="begin", choices=STAGES, help="repeat this stage and all after it")
    add_hints(parser)
    add(
        "--replace-masks",
        action="store_true",
        help="make the masks again, also those that were fixed by hand",
    )
    shared.add_device(parser)


def add_hints(parser: argparse.ArgumentParser) -> None:
    """Add the options that tell a capture about the photographs."""
    add = parser.add_argument
    add(
        "--turntable",
        action=argparse.BooleanOptionalAction,
        help="the camera stands still and the object turns (say so where it is not noticed)",
    )
    masks = parser.add_mutually_exclusive_group()
    masks.add_argument(
        "--masks", metavar="FOLDER", help="masks named like the photographs, white on the object"
    )
    masks.add_argument(
        "--mask-command",
        metavar="PROGRAM",
        help="program that makes masks, as 'rembg i {image} {mask}'",
    )
    add(
        "--box",
        type=_box,
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="where the object is, in the units of the scene; write --box=-1,-1,...",
    )


def _box(text):
    """Convert --box to AUTO or two corners."""
    return text if text == AUTO else shared.box(text)


def run(options: argparse.Namespace) -> None:
    """Run the stages that are not done yet."""
    from pathlib import Path

    from pp_cl.errors import UserError, pasted
    from pp_studio.capture.stages import Capture

    source = Path(options.source)
    if not source.exists():
        raise UserError(f"{source}: no such folder or video; give the photographs")
    given: dict[str, Any] = {"source": str(source.resolve())}
    if options.turntable is not None:
        given["turntable"] = options.turntable
    if options.box:
        given["box"] = None if options.box == AUTO else options.box
    if options.masks or options.mask_command:  # each replaces the other
        own = None if options.masks in (None, AUTO) else str(Path(options.masks).resolve())
        command = None if options.mask_command == AUTO else options.mask_command
        given |= {"masks": own, "mask_command": command}
    out, device = Path(options.out), options.device
    capture = Capture(out, given, lambda line: print(line, flush=True), device)
    capture.run(options.begin, replace_masks=options.replace_masks)
    print(
        f"look at it with `pp-cl info {pasted(options.out)} --picture look.png`, then `pp-cl train`"
    )
