"""From a run to the folder of a compressed one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pp_cl.compress.reduction import Original, Reduction
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_folder, write_json, write_text
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import Run
from pp_cl.scene.load import scene_splits
from pp_cl.scene.views import View

REPORT = "compress.json"
MOST_VIEWS, HELD_EVERY = 16, 8


def validation_views(run: Run) -> tuple[str, list[View]]:
    """(which they are, views) to measure a loss on, at most MOST_VIEWS: those of the split val,
    where the scene has none every eighth of the training views. Never those of a test. Raises
    UserError where the scene is missing or broken.
    """
    run.check_scene()
    present = scene_splits(run.config.scene.path)
    split = "val" if "val" in present else "train"
    views = run.scene(split).splits[split]
    if split == "train":
        views = views[::HELD_EVERY]
    count = min(MOST_VIEWS, len(views))
    views = [views[i * len(views) // count] for i in range(count)]
    return f"{count} views of {split}", views


def check_finished(run: Run) -> None:
    """Raise UserError for a run that is not finished."""
    if not run.header["finished"]:
        raise UserError(f"{run.folder}: its training is not finished; finish it first")


def write_compressed(
    original: Original, reduction: Reduction, out: Path, report: dict[str, Any]
) -> None:
    """Write a run folder that evaluates, renders and exports like any other, and the report."""
    with atomic_folder(out) as unfinished:
        folder = RunFolder(unfinished)
        write_text(folder.config, original.config(reduction).to_json() + "\n")
        folder.save(original.run.header, original.reduced_arrays(reduction))
        write_json(unfinished / REPORT, report)
