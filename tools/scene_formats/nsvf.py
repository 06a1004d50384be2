"""A scene as NSVF has it: rgb/ (RGBA), pose/, intrinsics.txt."""

from pathlib import Path

import numpy as np

from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.scene.readers.nsvf import PREFIXES
from tools.scene_formats.common import number, one_lens


def write(folder: Path, splits: dict[str, list[View]]) -> None:
    """Write the views. Raises UserError for views with different intrinsics, other splits than
    train, val and test, and val without test: readers take 1_ for test where there is no 2_.
    """
    prefixes = {split: prefix for prefix, split in PREFIXES.items()}
    if set(splits) - set(prefixes):
        raise UserError(f"NSVF knows the splits {', '.join(prefixes)} only")
    if "val" in splits and "test" not in splits:
        raise UserError("NSVF has no val without test; convert both, or name it test")
    lens = one_lens([view for views in splits.values() for view in views], "NSVF")
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True)
    for split, views in splits.items():
        for i, view in enumerate(views):
            name = f"{prefixes[split]}{split}_{number(i)}"
            write_png(folder / "rgb" / f"{name}.png", view.image)
            pose = np.vstack([view.stored_camera.pose, [0, 0, 0, 1]])
            np.savetxt(folder / "pose" / f"{name}.txt", pose, "%.17g")
    matrix = np.eye(4)
    matrix[:2, :3] = [[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy]]
    np.savetxt(folder / "intrinsics.txt", matrix, "%.17g")
