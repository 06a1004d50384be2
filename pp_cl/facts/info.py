"""What a run or a scene is, in numbers that JSON can hold."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from pp_cl.config import Config, assign, configure, load_config, preset
from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.files.run_folder import MOST_METRICS, RunFolder
from pp_cl.files.untrusted import read_json_text, refusal
from pp_cl.scene.agreement import Disagreement, disagreements
from pp_cl.scene.camera_path import looked_at, up_of
from pp_cl.scene.grid import Grid
from pp_cl.scene.hull import Hull, build_grid, spacing_pixels
from pp_cl.scene.load import (
    open_scene,
    preset_downscale,
    scene_box,
    scene_format,
    scene_frames,
    scene_splits,
)
from pp_cl.scene.outline import SHOWN_VIEWS, picture
from pp_cl.scene.views import MASK_THRESHOLD, Photograph, View
from pp_cl.training.checkpoint import opened_run

Facts = dict[str, Any]
Given = tuple[str, Any, str]  # a setting: key, value or its text, origin


# --------------------------------------------------------------------------------------------------


def run_facts(folder: RunFolder, scene: str | None = None) -> Facts:
    """What a run is, from its files alone; what they do not tell is None.

    scene: where its scene is now, if it has moved. Raises UserError naming the file that is missing
    or broken.
    """
    config = _config(folder, scene)
    facts = {
        "run": str(folder),
        "preset": config.preset,
        "scene": config.scene.path,
        "downscale": config.scene.downscale,
        "iterations": config.train.iterations,
        "network": {
            "widths": list(config.network.widths),
            "blocks": config.network.blocks,
            "parameters": None,
        },
        "step": 0,
        "finished": False,
        "points": None,
        "grid": None,
        "checkpoint_bytes": None,
        **_logged(folder),
        **_metrics(folder),
    }
    if folder.checkpoint.exists():
        with opened_run(folder, config) as stored:
            header, forms = stored.header, stored.forms
        sizes = (math.prod(f.shape) for name, f in forms.items() if name.startswith("net."))
        facts["network"]["parameters"] = sum(sizes)
        facts |= {"step": header["step"], "finished": header["finished"]}
        left, grid = forms["points.ids"].shape[0], header["grid"]
        facts["points"] = {"initial": header["initial_points"], "left": left}
        facts["grid"] = grid | {"edge_pixels": _edge_pixels(config, Grid.of_header(grid))}
        facts["checkpoint_bytes"] = folder.checkpoint.stat().st_size
    return facts


def run_picture(dev: Device, folder: RunFolder, scene: str | None = None) -> np.ndarray:
    """picture() of the points that a run has left. Raises UserError as run_facts does, and for a
    scene that is missing or broken.
    """
    config = _config(folder, scene)
    with opened_run(folder, config) as stored:
        grid = Grid.of_header(stored.header["grid"])
        points = Hull(grid, stored.array("points.ids"), capped=False)
    return picture(dev, open_scene(dev, config, ("train",), SHOWN_VIEWS).splits["train"], points)


def _config(folder, scene):
    config = load_config(folder.config)
    return configure(config, scene or config.scene.path)


def _edge_pixels(config, grid):
    """The grid's edge in pixels of the run's images; None where the scene cannot be read."""
    try:
        frames = scene_frames(config.scene.path)
    except UserError:
        return None
    cameras = [frame.camera.downscaled(config.scene.downscale) for frame in frames]
    return spacing_pixels(grid, cameras)


def _logged(folder):
    """{"device", "seconds"} of the last row of the log, and the last "psnr"."""
    rows = folder.rows()
    last = rows[-1] if rows else {}
    values = [row["psnr"] for row in rows if "psnr" in row]
    return {
        "device": last.get("device"),
        "seconds": last.get("seconds"),
        "psnr": values[-1] if values else None,
    }


def _metrics(folder):
    """{"metrics": means of the evaluation of the test split, "metrics_step": the step it was made
    at}, None where there is none, or it does not tell.
    """
    file = folder.metrics("test")
    if not file.exists():
        return {"metrics": None, "metrics_step": None}
    again = f"run `pp-cl eval {folder}` again"
    try:
        text = read_json_text(file, MOST_METRICS)
    except (OSError, ValueError) as error:
        raise refusal(file, error, "metrics", again) from None
    try:
        result = json.loads(text)
        values = {name: float(value) for name, value in result["mean"].items()}
        step = result.get("step")
        if not all(map(math.isfinite, values.values())) or type(step) not in (int, type(None)):
            raise ValueError
        return {"metrics": values, "metrics_step": step}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise UserError(f"{file}: holds no metrics; {again}") from None


# --------------------------------------------------------------------------------------------------


class Described(NamedTuple):
    """A scene. hull: None where the masks give none. disagreeing: masks that the others
    contradict.
    """

    facts: Facts
    views: list[View]
    hull: Hull | None
    disagreeing: list[Disagreement]


def describe_scene(
    dev: Device, scene: str, preset_name: str, given: Iterable[Given] = ()
) -> Described:
    """What a scene is, from its training views and the cameras of the others.

    preset_name: whose number of points the hull gets, and whose size the images. given: settings,
    as configure takes them. Raises UserError for a scene that is missing or broken; what prevents a
    hull is a fact.
    """
    given = list(given)
    config = configure(preset(preset_name), scene, given)
    path = config.scene.path
    if "scene.downscale" not in [key for key, _, _ in given]:
        assign(config, "scene.downscale", preset_downscale(path, preset_name), "preset")
    names = sorted(scene_splits(path), key=lambda split: (split == "test", split))
    frames = {split: scene_frames(path, split) for split in names}
    views = open_scene(dev, config, ("train",)).splits["train"]
    hull, problem = _hull(dev, views, config)
    found = disagreements(views, hull.grid.box) if hull else []
    facts = {
        "scene": path,
        "format": scene_format(path),
        "splits": {split: len(listed) for split, listed in frames.items()},
        "images": _sizes([frame for listed in frames.values() for frame in listed]),
        **_lenses(views),
        "masks": _masks(views) | {"disagreeing": _disagreeing(found)},
        "depth_range": _stated_range(views),
        **_rig(views),
        "preset": preset_name,
        "downscale": config.scene.downscale,
        "hull": _hull_facts(hull, [view.camera for view in views]),
        "problem": problem,
    }
    return Described(facts, views, hull, found)


def _hull(dev, views, config: Config):
    """(Hull, None), or (None, why there is none)."""
    try:
        return build_grid(dev, views, config.points.count, scene_box(config)), None
    except UserError as error:
        return None, str(error)


def _sizes(frames: Sequence[Photograph]):
    return dict(Counter(f"{frame.camera.width}x{frame.camera.height}" for frame in frames))


def _range(values):
    return [float(min(values)), float(max(values))]


def _lenses(views):
    """Least and most of the training views: focal length, angles of view."""
    cameras = [view.file_camera for view in views]
    angles = [
        [math.degrees(2 * math.atan(size / (2 * focal))) for size, focal in pairs]
        for pairs in (
            [(c.width, c.fx) for c in cameras],
            [(c.height, c.fy) for c in cameras],
        )
    ]
    return {
        "focal_pixels": _range([focal for c in cameras for focal in (c.fx, c.fy)]),
        "field_of_view": {"x": _range(angles[0]), "y": _range(angles[1])},
    }


def _masks(views):
    """{"with_alpha": share of the views whose image has a transparent pixel, "object": mean share
    of such an image that shows the object, None where there is none}.
    """
    masks = [view.image[..., 3] for view in views if view.has_mask]
    shares = [float((mask > MASK_THRESHOLD).mean()) for mask in masks]
    return {
        "with_alpha": len(masks) / len(views),
        "object": float(np.mean(shares)) if shares else None,
    }


def _disagreeing(found):
    return [{"view": one.view.name, "share": one.share} for one in found]


def _stated_range(views):
    ranges = [view.depth_range for view in views if view.depth_range]
    if not ranges:
        return None
    return [min(near for near, _ in ranges), max(far for _, far in ranges)]


def _rig(views):
    """What the cameras look at, their distances from it, and the direction up."""
    cameras = [view.stored_camera for view in views]
    centre = looked_at(cameras)
    return {
        "looked_at": centre.tolist(),
        "distances": _range([np.linalg.norm(camera.eye - centre) for camera in cameras]),
        "up": up_of(cameras).tolist(),
    }


def _hull_facts(hull, cameras):
    if hull is None:
        return None
    grid = hull.grid
    return {
        "points": len(hull.ids),
        "capped": hull.capped,
        "dims": list(grid.dims),
        "edge": grid.edge,
        "edge_pixels": spacing_pixels(grid, cameras),
        "box": grid.box.tolist(),
    }
