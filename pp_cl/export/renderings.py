"""The views of a run's scene as the run renders them, as a scene for other programs."""

from __future__ import annotations

from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.evaluate import image_files
from pp_cl.files.image import to_8bit
from pp_cl.scene.demo import SPLITS
from pp_cl.scene.load import Scene
from pp_cl.scene.views import View
from pp_cl.trained import Run


def renderings(run: Run) -> Scene:
    """The train and test views at the run's resolution, each image the run's rendering of it as
    straight RGBA; a test split that the run's scene does not have is left out.

    Raises UserError for a training split that cannot be read.
    """
    splits = {split: _rendered(run, split) for split in SPLITS}
    splits = {split: views for split, views in splits.items() if views}
    return Scene(run.folder.path.name, None, splits)


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
