"""The views of a run's scene as the run renders them, as a scene for other programs."""

from __future__ import annotations

import warnings

from tqdm import tqdm

from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.run import Run, image_files
from pp_cl.scene.views import View


def renderings(run: Run) -> dict[str, list[View]]:
    """{split: views}: those of train and test at the run's resolution, each image the run's
    rendering of it as straight RGBA; where the run's scene has no test views, or none that can be
    read, those are left out with a warning that says why.
    """
    splits = {"train": run.photographs("train")}
    try:
        splits["test"] = run.photographs("test")
    except UserError as error:
        warnings.warn(f"no test views are exported: {error}", stacklevel=2)
    return {split: _rendered(run, split, listed) for split, listed in splits.items()}


def _rendered(run, split, photographs):
    """The views of a split."""
    files = image_files([one.name for one in photographs])
    bar = tqdm(photographs, f"rendering {split}", unit="view", leave=False, disable=None)
    views = []
    for one, file in zip(bar, files, strict=True):
        camera = one.camera.downscaled(run.config.scene.downscale)
        image = to_8bit(run.render(camera).rgba())
        views.append(View(f"{split}/{file}", camera, image, one.depth_range))
    return views
