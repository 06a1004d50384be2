"""The views of a run's scene as the run renders them, as a scene for other programs."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.evaluate import image_files
from pp_cl.files.image import to_8bit
from pp_cl.scene.demo import SPLITS, write_scene
from pp_cl.scene.load import Scene
from pp_cl.scene.views import View
from pp_cl.trained import Run


def write_renderings(folder: Path | str, run: Run) -> dict[str, int]:
    """Write a NeRF-synthetic folder of the run's renderings, straight RGBA, of the train and test
    views at the run's resolution. Returns the number of views by split; a test split that the
    scene does not have is left out.

    Raises UserError as write_scene does, and for a training split that cannot be read.
    """
    splits = {split: _rendered(run, split) for split in SPLITS}
    splits = {split: views for split, views in splits.items() if views}
    write_scene(Scene(run.folder.path.name, None, splits), folder)
    return {split: len(views) for split, views in splits.items()}


def _rendered(run, split):
    """The views of a split; none of a test split that cannot be read."""
    try:
        views = run.scene(split).splits[split]
    except UserError:
        if split == "train":
            raise
        return []
    files = image_files([view.name for view in views])
    return [
        View(
            f"{split}/{file}",
            view.camera,
            to_8bit(run.render(view.camera).rgba()),
            view.depth_range,
        )
        for view, file in zip(
            tqdm(views, f"rendering {split}", unit="view", leave=False, disable=None),
            files,
            strict=True,
        )
    ]
