"""A scene as nerfstudio has it: one transforms.json, images and masks, the splits by name."""

from pathlib import Path

from pp_cl.engine.views import View
from pp_cl.files.atomic import write_json
from pp_cl.scene.readers.frame import frame_keys
from tools.scene_formats.common import number, write_mask, write_rgb


def write(folder: Path, splits: dict[str, list[View]]) -> None:
    """Write the views."""
    frames, names = [], {}
    for split, views in splits.items():
        for view in views:
            name = f"{number(len(frames))}.png"
            write_rgb(folder / "images" / name, view)
            write_mask(folder / "masks" / name, view)
            frame = {"file_path": f"images/{name}", "mask_path": f"masks/{name}"}
            if view.depth_range:
                frame["near"], frame["far"] = view.depth_range
            frames.append(frame | frame_keys(view.stored_camera))
            names.setdefault(f"{split}_filenames", []).append(f"images/{name}")
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", "frames": frames} | names)
