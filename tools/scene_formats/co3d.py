"""A scene as the only sequence of the only category of CO3D, version 2: the scene is the folder
object/sequence of what is written.
"""

import gzip
import json
from pathlib import Path

import numpy as np

from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.scene.readers.co3d import ANNOTATIONS, CV_FROM_P3D, ISOTROPIC, NORMALISED
from tools.scene_formats.common import number, write_mask, write_rgb

CATEGORY, SEQUENCE = "object", "sequence"


def write(folder: Path, splits: dict[str, list[View]], version: int = 2) -> None:
    """Write the sequence and the annotations beside it. Raises UserError for splits that the
    format's set lists cannot tell.
    """
    _check(splits, version)
    annotations, listed, category = [], {}, folder / CATEGORY
    for split, views in splits.items():
        for view in views:
            index = len(annotations)
            name = f"frame{number(index)}.png"
            write_rgb(category / SEQUENCE / "images" / name, view)
            write_mask(category / SEQUENCE / "masks" / name, view)
            paths = [f"{CATEGORY}/{SEQUENCE}/{kind}/{name}" for kind in ("images", "masks")]
            annotations.append(_annotation(index, view, paths, version))
            listed.setdefault(_set(split, version), []).append([SEQUENCE, index, paths[0]])
    with gzip.open(category / ANNOTATIONS, "wt") as file:
        json.dump(annotations, file)
    name = "set_lists.json" if version == 1 else "set_lists/set_lists_manyview_dev_0.json"
    lists = category / name
    lists.parent.mkdir(exist_ok=True)
    lists.write_text(json.dumps(listed))


def _check(splits, version):
    known = {"train", "test"} | ({"val"} if version == 2 else set())
    filled = {split for split, views in splits.items() if views}
    if set(splits) - known or not {"train", "test"} <= filled:
        raise UserError(
            f"a sequence of CO3D {version} has the splits {', '.join(sorted(known))}, this scene"
            f" {', '.join(sorted(filled))}; deal them out again with --hold-out"
        )


def _set(split, version):
    return {"train": "train_known", "test": "train_unseen"}[split] if version == 1 else split


def _annotation(index, view, paths, version):
    camera = view.stored_camera
    half = np.array([camera.width, camera.height]) / 2
    scale = half if version == 1 else half.min()
    rotation = camera.pose[:, :3] @ CV_FROM_P3D  # of row vectors: world to camera
    viewpoint = {
        "R": rotation.tolist(),
        "T": (-camera.eye @ rotation).tolist(),
        "focal_length": ([camera.fx, camera.fy] / scale).tolist(),
        "principal_point": ((half - [camera.cx, camera.cy]) / scale).tolist(),
        "intrinsics_format": NORMALISED if version == 1 else ISOTROPIC,
    }
    # without pixels left unsaid: a reader leaves out the frames whose masks are known to be empty
    mass = float((view.image[..., 3] > 0).sum())
    return {
        "sequence_name": SEQUENCE,
        "frame_number": index,
        "image": {"path": paths[0], "size": [camera.height, camera.width]},
        "mask": {"path": paths[1], "mass": mass or None},
        "viewpoint": viewpoint,
    }
