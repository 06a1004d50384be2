"""The facts about a run or a scene that `pp-cl info` prints, as numbers for JSON."""

import itertools
import math
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.checkpoint import opened_run, progress_of
from pp_cl.config import Given, scene_config
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.network.layers import multiplications, unet_layers
from pp_cl.engine.raster.weights import ALL
from pp_cl.engine.training.schedule import refinements
from pp_cl.engine.views import MASK_THRESHOLD, View, evenly
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import load, scene_is_there, stored_config
from pp_cl.scene.agreement import Disagreement
from pp_cl.scene.edits import read_edits
from pp_cl.scene.gaze import looked_at, up_of
from pp_cl.scene.hull import Hull, contradicting, spacing_pixels
from pp_cl.scene.identity import unpacked_views
from pp_cl.scene.listing import DEMO, scene_box, scene_format, scene_frames, scene_splits
from pp_cl.scene.load import open_scene
from pp_cl.scene.outline import SHOWN_VIEWS, outline_sheet
from pp_cl.scene.verdict import WrongCameras, judged
from pp_cl.session.decide import first_hull

WORK_VIEWS = 8  # number of views in which run_work() counts

Facts = dict[str, Any]


def run_facts(folder: RunFolder, scene: str | None = None) -> Facts:
    """Facts about a run, from its files alone; those that they do not tell are None. scene: where
    the scene is now. Raises UserError naming the file that is missing or broken.
    """
    config, rows, measured = stored_config(folder, scene), folder.rows(), folder.measured()
    last, network = rows[-1] if rows else {}, config.network
    facts = {
        "run": str(folder),
        "preset": config.preset,
        "scene": config.scene.path,
        "scene_is_there": scene_is_there(config.scene.path),
        "views": None,
        "downscale": config.scene.downscale,
        "decisions": config.decisions,
        "iterations": config.train.iterations,
        "network": {"widths": list(network.widths), "blocks": network.blocks, "parameters": None},
        "step": 0,
        "finished": False,
        "notes": [],
        "points": None,
        "grid": None,
        "cells": None,
        "work": None,
        "device": last.get("device"),
        "seconds": last.get("seconds"),
        "psnr": next((row["psnr"] for row in reversed(rows) if "psnr" in row), None),
        "metrics": measured and measured["mean"],
        "metrics_step": measured and measured["step"],
        "files": _files(folder.path),
    }
    if not folder.checkpoint.exists():
        return facts
    with opened_run(folder, config) as stored:
        header, forms = stored.header, stored.forms
    sizes = (math.prod(f.shape) for name, f in forms.items() if name.startswith("net."))
    facts["network"]["parameters"] = sum(sizes)
    image_files, grid = unpacked_views(header["views"]), header["grid"]
    initial, points_left = header["initial_points"], forms["points.ids"].shape[0]
    points = [form for name, form in forms.items() if name.startswith("points.")]
    of_point = sum(math.prod(form.shape[1:]) * form.dtype.itemsize for form in points)
    whole, size = math.prod(grid["dims"]), folder.checkpoint.stat().st_size
    progress = progress_of(header, config.train.iterations)
    refined = sum(at <= progress for at in refinements(config.train))
    if "extended_from" in header:  # all refinements came before
        refined = sum(0 < share < 1 for share in config.train.refine_at)
    cameras = [image_file.camera.downscaled(config.scene.downscale) for image_file in image_files]
    return facts | {
        "step": header["step"],
        "finished": header["finished"],
        "notes": header.get("notes", []),
        "views": {"count": len(image_files), "images": _image_sizes(image_files)},
        "points": {"initial": initial, "left": points_left, "pruned": _prunings(rows)},
        "grid": grid | {"voxel_size_pixels": spacing_pixels(Grid.of_header(grid), cameras)},
        # all counts are of cells of the present size
        "cells": {
            "box": whole,
            "hull": initial * 8**refined,
            "left": points_left,
            "checkpoint_bytes": size,
            "box_bytes": size + (whole - points_left) * of_point,
        },
    }


def _prunings(rows):
    """The number of points after each pruning, from the rows of a log; refinements do not count."""
    counts = [row["points"] for row in rows if "points" in row]
    return [after for before, after in itertools.pairwise(counts) if after < before]


def run_work(dev: Device, folder: RunFolder) -> Facts:
    """The work for a view of a run and for a training step, as means over some training views:
    {"views", "fragments": {"found", "blended"}, "drawn": points; "step", for the crop in the middle
    of the view, or all of a smaller view: {"side", "touched": points that get gradients,
    "with_gradients": fragments}; "network": {"tiles": share that shows points, "multiplications",
    "whole": multiplications for the whole image}}. Raises UserError as load() does.
    """
    run = load(folder.path, dev)
    renderer, network = run.renderer, run.config.network
    layers = unet_layers(network.widths, blocks=network.blocks)
    side, tracked, rows = run.config.train.crop, run.config.raster.max_tracked, []
    for camera in evenly(run.cameras("train"), WORK_VIEWS):
        image = renderer.forward(camera, run.gamma)
        size, computed = image.size, image.computed_fraction
        del image  # frees its arrays before the next forward()
        view = renderer.forward(camera, run.gamma, until="weights")
        fragments, blended, drawn, tiles = _counted(view, tracked)
        del view
        width, height = (min(side or n, n) for n in (camera.width, camera.height))
        left, top = (camera.width - width) // 2, (camera.height - height) // 2
        crop = camera.crop(left, top, width, height)
        step = _counted(renderer.forward(crop, run.gamma, until="weights"), tracked)
        whole = multiplications(layers, *size)
        rows.append([fragments, blended, drawn, tiles, *step[1:3], whole * computed, whole])
    means = np.mean(rows, axis=0).tolist()
    fragments, blended, drawn, tiles, with_gradients, touched, done, whole = means
    return {
        "views": len(rows),
        "fragments": {"found": fragments, "blended": blended},
        "drawn": drawn,
        "step": {"side": side, "touched": touched, "with_gradients": with_gradients},
        "network": {"tiles": tiles, "multiplications": done, "whole": whole},
    }


def _counted(result, tracked):
    """[fragments found, fragments blended (before the early stop and tracked), their points, share
    of the network's tiles that show points] of a view rendered up to its weights. tracked:
    raster.max_tracked.
    """
    found, shown = result.fragments()
    blended = np.minimum(shown, tracked or ALL)
    covered = result.weights.is_covered.get() != 0
    return [found.sum(), blended.sum(), result.weights.total, covered.mean()]


def run_sheet(dev: Device, folder: RunFolder, scene: str | None = None) -> np.ndarray:
    """outline_sheet() of the points that a run has left, over renderings without its scene."""
    run = load(folder.path, dev, scene=scene)
    path = run.config.scene.path
    points = Hull(run.model.grid, run.model.cloud.ids.get(), capped=False)
    if scene_is_there(path):
        views = open_scene(dev, run.config, ("train",), SHOWN_VIEWS).splits["train"]
    else:
        warnings.warn(
            f"{path}: is not there; the image shows the run's renderings in place of images",
            stacklevel=2,
        )
        views = run.rendered(evenly(run.image_files("train"), SHOWN_VIEWS), opaque=True)
    return outline_sheet(dev, views, points)


def _files(folder):
    """{name: bytes} of the files in a folder; a subfolder counts as the sum of its files."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    sizes = Counter()
    for file in files:
        sizes[file.relative_to(folder).parts[0]] += file.stat().st_size
    return {name: size for name, size in sizes.items() if not name.startswith(".")}


def _image_sizes(image_files):
    """{WxH: how many images have it}."""
    return dict(Counter(f"{p.camera.width}x{p.camera.height}" for p in image_files))


def describe_scene(
    dev: Device, scene: str, preset_name: str, given: Iterable[Given] = ()
) -> tuple[Facts, list[View], Hull | None, list[Disagreement]]:
    """(facts about a scene with a preset's and the given settings, its training views, their hull,
    None if the masks give none, the masks that the others contradict). Raises UserError for a scene
    that is missing or broken; what else prevents a hull is reported as a fact.
    """
    config = scene_config(scene, preset_name, given)
    path = config.scene.path
    names = sorted(scene_splits(path), key=lambda split: (split == "test", split))
    frames = {split: scene_frames(path, split) for split in names}
    opened = open_scene(dev, config, ("train",))
    views = opened.splits["train"]
    hull, problem, is_refused, right = None, None, False, views
    box = scene_box(config)
    try:
        agreement, beside = judged(dev, config, views)
        hull, shares = first_hull(dev, config, agreement)
        right = agreement.views
    except UserError as error:
        problem, is_refused = str(error), isinstance(error, WrongCameras)
    disagreements = contradicting(views, hull, agreement) if hull else []
    ranges = np.array([view.depth_range for view in right if view.depth_range])
    cameras, stored, lenses = (
        [getattr(view, name) for view in right]
        for name in ("camera", "stored_camera", "file_camera")
    )
    centre = looked_at(stored)
    facts = {
        "scene": path,
        "format": scene_format(path),
        "splits": {split: len(listed) for split, listed in frames.items()},
        "notes": list(opened.notes),
        "images": _image_sizes([frame for listed in frames.values() for frame in listed]),
        "focal_pixels": _range([focal for lens in lenses for focal in (lens.fx, lens.fy)]),
        "field_of_view": {
            "x": _angles((lens.width, lens.fx) for lens in lenses),
            "y": _angles((lens.height, lens.fy) for lens in lenses),
        },
        "masks": _masks(right)
        | {"disagreeing": [{"view": mask.view.name, "share": mask.share} for mask in disagreements]}
        | ({"left_out": agreement.left_out, "forgiven": agreement.forgiven} if hull else {}),
        "depth_range": [float(ranges.min()), float(ranges.max())] if len(ranges) else None,
        "looked_at": centre.tolist(),
        "distances": _range([np.linalg.norm(camera.eye - centre) for camera in stored]),
        "up": up_of(stored).tolist(),
        "preset": preset_name,
        "downscale": config.scene.downscale,
        "box": None if box is None else box.tolist(),
        "dropped": [] if path == DEMO else sorted(read_edits(Path(path)).dropped),
        "hull": None,
        "problem": problem,
        "cameras_are_wrong": is_refused,
    }
    if hull:
        facts["hull"] = {
            "points": len(hull.ids),
            "capped": hull.capped,
            "dims": list(hull.grid.dims),
            "voxel_size": hull.grid.voxel_size,
            "voxel_size_pixels": spacing_pixels(hull.grid, cameras),
            "refinements": sum(0 < share < 1 for share in shares),
            "box": hull.grid.box.tolist(),
            "masks_beside": beside,
        }
    return facts, views, hull, disagreements


def _range(values):
    return [float(min(values)), float(max(values))]


def _angles(sides):
    """Least and most degrees across (pixels, focal length)."""
    return _range([math.degrees(2 * math.atan(size / (2 * focal))) for size, focal in sides])


def _masks(views):
    """{"with_alpha": share of the views with a mask, "object": mean share of pixels in a mask}."""
    masks = [view.image[..., 3] for view in views if view.has_mask]
    shares = [float((mask > MASK_THRESHOLD).mean()) for mask in masks]
    return {
        "with_alpha": len(masks) / len(views),
        "object": float(np.mean(shares)) if shares else None,
    }
