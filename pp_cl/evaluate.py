"""Evaluation of a run: every view of a split, rendered, rounded to 8 bits, measured."""

import time
from pathlib import PurePosixPath

import numpy as np

from pp_cl.config import assign, load_config, validate
from pp_cl.device.discover import open_device
from pp_cl.files.atomic import remove_leftovers, write_json
from pp_cl.files.contact_sheet import write_comparison
from pp_cl.files.image import write_png
from pp_cl.layers.policy import load_policy
from pp_cl.metrics.psnr_ssim import Metrics, mean
from pp_cl.model import Model
from pp_cl.render import Renderer
from pp_cl.run import CHECKPOINT, load_run, open_scene, with_depth_range
from pp_cl.scene.target import Target
from pp_cl.scene.views import reduced_camera
from pp_cl.training.schedule import gamma

PICTURE_VIEWS = 4  # rows of the comparison picture


def evaluate_run(folder, metrics, split, save_images, device_choice, tolerance=None):
    """Measure a run; writes RUN/eval/metrics.json and comparison.png, prints a table, returns the
    metrics.

    metrics: names out of psnr, ssim, lpips; tolerance: text for network.tolerance, None = the
    run's. Raises UserError for a missing or broken run or split.
    """
    config = load_config(folder / "config.json")
    if tolerance is not None:
        assign(config, "network.tolerance", tolerance, "--tolerance")
        validate(config, "--tolerance")
    header, arrays = load_run(folder / CHECKPOINT)
    dev = open_device(device_choice)
    policy = load_policy(dev, config.network.tolerance)
    print(policy.origin)
    scene = open_scene(dev, config, (split,))
    measure = Metrics(dev, metrics, policy.blocking)
    model = Model.load(
        dev,
        header,
        arrays,
        config.network.widths,
        config.points.sh_degree,
        folder / CHECKPOINT,
        policy=policy,
    )
    views = with_depth_range(scene.splits[split], model.depth_range)

    target_folder = folder / "eval"
    (target_folder / "images" if save_images else target_folder).mkdir(parents=True, exist_ok=True)
    remove_leftovers(target_folder)
    gamma_now = gamma(header["step"], config.train.iterations, *config.raster.gamma)
    shown = {len(views) * i // PICTURE_VIEWS for i in range(PICTURE_VIEWS)}
    rows, pictures, seconds, fractions = [], [], [], []
    for i, (view, picture, truth, duration, fraction, dropped) in enumerate(
        _render_all(dev, config, model, views, gamma_now)
    ):
        rows.append({"name": view.name} | measure(picture, truth) | dropped)
        seconds.append(duration)
        fractions.append(fraction)
        if i in shown:
            pictures.append((picture, truth))
        if save_images:
            write_png(target_folder / "images" / f"{PurePosixPath(view.name).stem}.png", picture)
    result = {
        "split": split,
        "device": dev.name,
        "step": header["step"],
        "finished": header["finished"],
        "mean": mean([{name: row[name] for name in ("name", *metrics)} for row in rows]),
        "per_image": rows,
        "points": {
            "initial": header["initial_points"],
            "final": model.count,
            "grid": header["grid"]["dims"],
        },
        "seconds_per_frame": float(np.median(seconds)),
        # of the network's multiplications; the rest saw background alone
        "network_share": float(np.mean(fractions)),
        "published": scene.published,
    }
    write_json(target_folder / "metrics.json", result)
    write_comparison(target_folder / "comparison.png", *zip(*pictures, strict=True))
    _print_table(result, folder)
    print(
        f"wrote {target_folder / 'metrics.json'} and {target_folder / 'comparison.png'} (prediction"
        " | truth | 4 x error)"
    )
    return result


def _render_all(dev, config, model, views, gamma_now):
    """Yield (view, prediction (H,W,3), truth (H,W,3), seconds of the rendering, computed fraction
    of the network, what tau did); images as float32 in [0, 1].
    """
    model.net.freeze()
    renderer, target = Renderer(dev, model, config.raster), Target(dev, config.scene.downscale)
    # builds the programs
    renderer.render(reduced_camera(views[0], config.scene.downscale), gamma_now)
    for view in views:
        camera = reduced_camera(view, config.scene.downscale)
        start = time.perf_counter()
        result = renderer.forward(camera, gamma_now)
        picture = result.clamped(camera)
        seconds = time.perf_counter() - start
        target.load(view)
        truth = target.crop(0, 0, camera.width, camera.height).get()
        yield (
            view,
            picture,
            truth,
            seconds,
            result.computed_fraction,
            _tau_errors(renderer, camera, gamma_now) if config.raster.tau > 0 else {},
        )


def _tau_errors(renderer, camera, gamma_now):
    """{"tau_bound", "tau_feature_error", "tau_picture_error"} of a view.

    The largest weight that a pixel dropped (or its bound), and the largest differences from tau 0:
    of a feature over the range of the features, and of the image.
    """
    view = renderer.rasterise(camera, gamma_now)
    bound, features = renderer.dropped_weights(view).get().max(initial=0), view.features.get()
    exact = renderer.rasterise(camera, gamma_now, tau=0.0).features.get()
    image, exact_image = (renderer.render(camera, gamma_now, tau=tau) for tau in (None, 0.0))
    return {
        "tau_bound": float(bound),
        "tau_feature_error": float(np.abs(features - exact).max() / max(np.ptp(exact), 1e-30)),
        "tau_picture_error": float(np.abs(image - exact_image).max()),
    }


def _print_table(result, folder):
    names = list(result["mean"])
    print(f"{'':28s}" + "".join(f"{n:>9s}" for n in names))
    rows = {f"{folder} ({len(result['per_image'])} views)": result["mean"]} | {
        f"{k} (published)": v for k, v in result["published"].items()
    }
    for label, values in rows.items():
        print(
            f"{label:28s}"
            + "".join(f"{values[n]:9.4f}" if n in values else f"{'':9s}" for n in names)
        )
    points = result["points"]
    errors = {
        name: max(row.get(name, 0.0) for row in result["per_image"])
        for name in ("tau_bound", "tau_feature_error", "tau_picture_error")
    }
    if any(errors.values()):
        print(
            "raster.tau: dropped at most {:.1e} of a pixel; features off by {:.1e} of their range,"
            " the picture by {:.1e}".format(*errors.values())
        )
    share = (
        f"{result['network_share']:.0%} of the network's work, "
        if result["network_share"] < 1
        else ""
    )
    print(
        f"{points['final']} of {points['initial']} points, {share}"
        f"{result['seconds_per_frame'] * 1e3:.0f} ms per frame on {result['device']}"
    )
