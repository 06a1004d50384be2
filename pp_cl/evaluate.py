"""Measures a run on the views of a split."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.engine.training.target import Target
from pp_cl.files.atomic import own, remove_ours, write_json
from pp_cl.files.image import image_paths, write_png
from pp_cl.files.sheets import write_comparison
from pp_cl.metrics.psnr_ssim import Metrics, coloured_alike, mean
from pp_cl.metrics.published import differences, published_rows
from pp_cl.progress import Progress, track
from pp_cl.run import Run, load

SHOWN_VIEWS = 4  # rows of the comparison image


def evaluate_run(
    run: Run | Path | str,
    split: str = "test",
    metrics: tuple[str, ...] = ("psnr", "ssim"),
    *,
    save_images: bool = False,
    device: str | None = None,
    scene: str | None = None,
    out: Path | str | None = None,
    size: int = 0,
) -> dict[str, Any]:
    """Measure a run, or the run in a folder, as `pp-cl eval` does. Writes metrics.json, whose
    content it returns, and comparison.png into the folder `out`; None: RUN/eval for the split test,
    RUN/eval/SPLIT for others. If the run's images differed in colour, renderings are also measured
    with the images' colours, by coloured_alike().

    size: pixels of the views' longer side, drawn and measured so, in RUN/eval/size-SIZE; 0: as in
    the training. metrics: from psnr, ssim and lpips. save_images: also write every view to images/.
    device, scene: as in load(), for a folder. Raises UserError for a missing or broken split, for
    views smaller than `size`, and for files that would be lost.
    """
    run = run if isinstance(run, Run) else load(run, device, scene=scene)
    target = run.folder.evaluation(split, size) if out is None else Path(out)
    here = run.scene(split, size)
    views = here.splits[split]
    images = [target / "images" / file for file in image_paths([view.name for view in views])]
    measure = Metrics(run.dev, metrics)
    written = [target / "metrics.json", target / "comparison.png", *(images if save_images else [])]
    own(target, written, "move it away, or choose another --out", alone=out is not None)
    if save_images:
        remove_ours((target / "images").rglob("*"))
    rows: list[dict[str, Any]] = []
    costs, shown = [], []
    result: dict[str, Any]
    targets = Target(run.dev)
    with Progress("building kernels"):
        run.render(views[0].camera)
    for i, view in enumerate(track(views, "measuring", "view")):
        start = time.perf_counter()
        between = run.depth_range(view.camera)
        rendered = run.renderer.forward(view.camera, run.gamma, depth_range=between)
        image, computed = run.checked(run.shown(rendered)), rendered.computed_fraction
        costs.append((time.perf_counter() - start, computed))
        del rendered  # free its arrays before the next view, which may need larger ones
        whole = targets.crop(view, (0, 0, view.camera.width, view.camera.height))
        truth, alpha = (array.get() for array in whole)
        truth = view.ignoring(truth, image)
        rows.append({"name": view.name} | measure(image, truth))
        if "exposed" in run.header:
            coloured = view.ignoring(coloured_alike(image, truth, alpha), truth)
            rows[-1]["after_colour"] = measure(coloured, truth)
        if i in {len(views) * row // SHOWN_VIEWS for row in range(SHOWN_VIEWS)}:
            shown.append((image, truth))
        if save_images:
            images[i].parent.mkdir(parents=True, exist_ok=True)
            write_png(images[i], image)
    means = mean([{name: row[name] for name in metrics} for row in rows])
    result = {"split": split, "device": run.dev.name, "mean": means, "per_image": rows}
    if "exposed" in run.header:
        result["mean_after_colour"] = mean([row["after_colour"] for row in rows])
    header, cameras = run.header, [view.file_camera for view in views]
    points = {"initial": header["initial_points"], "final": run.model.cloud.count}
    published = published_rows(here.name, cameras)
    differs = differences(here.name, cameras, views[0].file_downscale, split) if published else ""
    differs = f"here: images of {size} pixels" if published and size else differs
    width, height = max((view.camera.width, view.camera.height) for view in views)
    result |= {
        "size": [width, height],
        "step": header["step"],
        "finished": header["finished"],
        "points": points | {"grid": header["grid"]["dims"]},
        "seconds_per_frame": float(np.median([seconds for seconds, _ in costs])),
        "computed_fraction": float(np.mean([computed for _, computed in costs])),
        "published": published,
        "published_differs": differs,
    }
    write_comparison(target / "comparison.png", *zip(*shown, strict=True))
    write_json(target / "metrics.json", result)  # last: `make` takes the picture to be there, too
    return result
