"""Write a scene in another format, the demo included.

    python -m tools.convert_scene SCENE OUT --format colmap

Formats are the modules in tools/scene_formats/. Images become PNG at the stored size, without lens
distortion; masks go where the format keeps them. Formats without splits hold out every eighth
photograph: for them, the views of both splits are dealt anew. --hold-out does so for any format, so
that all of them train and test on the same views.
"""

import argparse
import sys
from importlib import import_module
from pathlib import Path

from pp_cl.config import configure, preset
from pp_cl.drivers import open_device
from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_folder
from pp_cl.scene.listing import scene_splits
from pp_cl.scene.load import open_scene
from pp_cl.scene.readers.common import SPLITS, hold_out

FOLDER = Path(__file__).with_name("scene_formats")
FORMATS = sorted(file.stem for file in FOLDER.glob("*.py") if file.stem != "common")


def convert(splits: dict[str, list[View]], folder: Path, name: str) -> None:
    """Write the views of each split in a format. Raises UserError if the folder is not empty or
    the format cannot hold the views.
    """
    with atomic_folder(folder) as unfinished:
        import_module(f"tools.scene_formats.{name}").write(unfinished, splits)


def dealt(splits: dict[str, list[View]]) -> dict[str, list[View]]:
    """Deal the views to the splits train and test as formats without splits do."""
    views = [view for split in sorted(splits) for view in splits[split]]
    return {split: hold_out(views, split) for split in SPLITS}


def main(arguments: list[str] | None = None) -> int:
    """Convert; returns the exit status, 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scene", help="folder of a scene, or the word demo")
    parser.add_argument("out", type=Path, help="new folder")
    parser.add_argument("--format", required=True, choices=FORMATS)
    parser.add_argument("--hold-out", action="store_true", help="deal out the splits again")
    options = parser.parse_args(arguments)
    try:
        config = configure(preset("tiny"), options.scene)
        names = tuple(scene_splits(config.scene.path))
        splits = open_scene(open_device(), config, names).splits
        convert(dealt(splits) if options.hold_out else splits, options.out, options.format)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
