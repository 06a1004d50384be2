"""A scene as NeuS has it: cameras_sphere.npz, image/, mask/."""

from pathlib import Path

import numpy as np

from pp_cl.engine.views import View
from tools.scene_formats.common import number, ordered, write_mask, write_rgb


def write(folder: Path, splits: dict[str, list[View]]) -> None:
    """Write the views. scale_mat, the sphere around the object, is left out. Raises UserError for
    splits other than those that readers hold out.
    """
    matrices = {}
    for i, view in enumerate(ordered(splits)):
        write_rgb(folder / "image" / f"{number(i)}.png", view)
        write_mask(folder / "mask" / f"{number(i)}.png", view)
        matrices[f"world_mat_{i}"] = _projection(view.stored_camera)
    np.savez(folder / "cameras_sphere.npz", **matrices)


def _projection(camera):
    """(4, 4): K [R | t] above (0, 0, 0, 1)."""
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    rotation = camera.pose[:, :3].T
    upper = intrinsics @ np.column_stack([rotation, -rotation @ camera.eye])
    return np.vstack([upper, [0, 0, 0, 1]])
