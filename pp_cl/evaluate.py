"""Evaluation of a run: every view of a split, rendered, rounded to 8 bits, measured."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import check_writable, remove_leftovers, write_json
from pp_cl.files.contact_sheet import write_comparison
from pp_cl.files.image import write_png
from pp_cl.metrics.psnr_ssim import Metrics, mean
from pp_cl.metrics.published import differences, published_rows
from pp_cl.scene.target import Target
from pp_cl.scene.views import View
from pp_cl.trained import Run, load_run

SHOWN_VIEWS = 4  # rows of the comparison image
MARK = ".evaluation"  # file in a folder that evaluations may replace


class Rendered(NamedTuple):
    """A view as the run renders it.

    image, truth: (H, W, 3) float32 in [0, 1]. computed: fraction of the network's multiplications
    that were computed; the others would have seen background alone.
    """

    name: str
    image: np.ndarray
    truth: np.ndarray
    seconds: float
    computed: float


def evaluate_run(
    folder: Path | str,
    split: str = "test",
    metrics: tuple[str, ...] = ("psnr", "ssim"),
    *,
    save_images: bool = False,
    device: str | None = None,
    tolerance: float | None = None,
    scene: str | None = None,
    out: Path | str | None = None,
) -> dict[str, Any]:
    """evaluate() of the run in a folder. device: as `pp-cl eval --device`; tolerance, scene: as
    load_run takes them.
    """
    run = load_run(open_device(device), folder, tolerance=tolerance, scene=scene)
    return evaluate(run, split, metrics, save_images=save_images, out=out)


def evaluate(
    run: Run,
    split: str,
    metrics: tuple[str, ...],
    *,
    save_images: bool = False,
    out: Path | str | None = None,
    published: bool = False,
    on_view: Callable[[int, int], None] = lambda _measured, _views: None,
) -> dict[str, Any]:
    """Measure a run; writes metrics.json and comparison.png into the folder `out`, if not given
    RUN/eval, or RUN/eval/SPLIT for other splits than test, and returns the former.

    metrics: names out of psnr, ssim, lpips. save_images: write every view to images/ there, in
    place of what an earlier evaluation left. published: put published results beside also where
    they were measured on other views or sizes. on_view: called after each view with the number of
    those measured and of all. Raises UserError for a missing or broken split, a folder that may not
    be written, and an `out` that holds something else than an evaluation.
    """
    target = run.folder.evaluation(split) if out is None else Path(out)
    check_target(target, is_new=out is not None)
    scene = run.scene(split)
    views = scene.splits[split]
    measure = Metrics(run.dev, metrics, run.policy)
    target.mkdir(parents=True, exist_ok=True)
    if out is not None:
        (target / MARK).touch()
    remove_leftovers(target)
    if save_images and (target / "images").exists():
        shutil.rmtree(target / "images")
    files = image_files([view.name for view in views])
    rows, costs, shown = [], [], []
    for i, rendered in enumerate(render_views(run, views)):
        image, truth = rendered.image, rendered.truth
        rows.append({"name": rendered.name} | measure(image, truth))
        costs.append((rendered.seconds, rendered.computed))
        if i in {len(views) * row // SHOWN_VIEWS for row in range(SHOWN_VIEWS)}:
            shown.append((image, truth))
        if save_images:
            path = target / "images" / files[i]
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, image)
        on_view(i + 1, len(views))
    means = mean([{name: row[name] for name in metrics} for row in rows])
    result = {"split": split, "device": run.dev.name, "mean": means, "per_image": rows}
    result |= _about(run, costs) | _published(scene, split, views, anyway=published)
    write_json(target / "metrics.json", result)
    write_comparison(target / "comparison.png", *zip(*shown, strict=True))
    return result


def check_target(target: Path, *, is_new: bool) -> None:
    """Raise UserError where an evaluation cannot be written into a folder. is_new: nor if it holds
    files of others, of which images/ would be removed.
    """
    if target.exists() and not target.is_dir():
        raise UserError(f"{target}: is not a folder; choose another --out")
    check_writable(target)
    if is_new and target.exists() and not (target / MARK).exists() and any(target.iterdir()):
        raise UserError(f"{target}: holds other files; choose a new or empty folder for --out")


def _published(scene, split, views, *, anyway):
    """{"published": rows of the scene, "published_differs": how this measurement differs from
    them}. anyway: rows also where it does.
    """
    cameras = [view.file_camera for view in views]
    rows = published_rows(scene.name, cameras)
    differs = differences(scene.name, cameras, views[0].file_downscale, split) if rows else ""
    shown = anyway or not differs
    return {"published": rows if shown else {}, "published_differs": differs if shown else ""}


def _about(run, costs):
    """What metrics.json says of the run. costs: [(seconds, fraction computed)] of each view."""
    seconds, computed = zip(*costs, strict=True)
    return {
        "step": run.header["step"],
        "finished": run.header["finished"],
        "points": {
            "initial": run.header["initial_points"],
            "final": run.model.cloud.count,
            "grid": run.header["grid"]["dims"],
        },
        "seconds_per_frame": float(np.median(seconds)),
        "computed_fraction": float(np.mean(computed)),
    }


def image_files(names: list[str]) -> list[PurePosixPath]:
    """Relative paths of PNG files for views of these names: the folders in which they differ stay,
    those that all of them share go.
    """
    paths = [PurePosixPath(name) for name in names]
    shared = os.path.commonpath([path.parent for path in paths])
    paths = [path.relative_to(shared) for path in paths]
    files = [path.with_suffix(".png") for path in paths]
    if len(set(files)) < len(files):  # a.jpg beside a.png
        files = [path.with_name(f"{path.name}.png") for path in paths]
    return files


def render_views(run: Run, views: list[View]) -> Iterator[Rendered]:
    """Each view as the run renders it, in turn."""
    target = Target(run.dev)
    run.render(views[0].camera)  # builds the programs
    for view in views:
        start = time.perf_counter()
        result = run.renderer.forward(view.camera, run.gamma)
        image = run.checked(result.clamped(view.camera))
        seconds = time.perf_counter() - start
        target.load(view)
        truth = target.whole()
        yield Rendered(view.name, image, truth, seconds, result.computed_fraction)
