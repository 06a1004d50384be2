"""Write the demo scene as a NeRF-synthetic folder, with its mesh: python tools/demo_scene.py FOLDER
[--size S].
"""

import argparse
import sys
from pathlib import Path

import trimesh

from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.scene.demo import SIZE, SPLITS, demo_mesh, demo_views
from pp_cl.scene.readers.transforms import write_scene


def main() -> int:
    """Write the images and the mesh; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where to; must not exist, or be empty")
    parser.add_argument(
        "--size", type=int, default=SIZE, help=f"side of the images in pixels ({SIZE})"
    )
    options = parser.parse_args()
    try:
        dev = open_device()
        splits = {split: demo_views(dev, split, size=options.size) for split in SPLITS}
        write_scene(splits, options.folder)
    except UserError as error:
        print(f"demo_scene: {error}", file=sys.stderr)
        return 2
    trimesh.Trimesh(*demo_mesh(dev)).export(options.folder / "mesh.ply")
    print(f"wrote {options.folder}: transforms_*.json, images, mesh.ply")
    return 0


if __name__ == "__main__":
    sys.exit(main())
