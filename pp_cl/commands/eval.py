"""The command pp-cl eval."""

import argparse

from pp_cl.commands import options as shared

HELP = "render a run's views and measure them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run_folder", metavar="RUN", help="folder of the run")
    shared.add_metrics(parser)
    parser.add_argument("--split", default="test", help="train, val or test (default)")
    parser.add_argument(
        "--scene", metavar="SCENE", help="where the run's scene is now, if it has moved"
    )
    parser.add_argument(
        "--save-images", action="store_true", help="write every view to RUN/eval/images/"
    )
    shared.add_open(parser)
    shared.add_tolerance(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Evaluate, print the table."""
    from pp_cl.device.discover import open_device
    from pp_cl.evaluate import evaluate
    from pp_cl.trained import load_run

    metrics, tolerance = (
        shared.read_metrics(options.metrics),
        shared.read_tolerance(options.tolerance),
    )
    dev = open_device(options.device)
    run = load_run(dev, options.run_folder, tolerance=tolerance, scene=options.scene)
    print(run.policy.origin)
    result = evaluate(run, options.split, metrics, save_images=options.save_images)
    folder = run.folder
    print(_table(result, folder))
    print(_summary(result))
    written = folder.evaluation(options.split)
    print(
        f"wrote {written / 'metrics.json'} and {written / 'comparison.png'} (prediction"
        " | truth | 4 x error)"
    )
    if options.open:
        shared.show(written / "comparison.png")


def _table(result, folder):
    """The run's means above the published ones."""
    names = list(result["mean"])
    rows = {f"{folder} ({len(result['per_image'])} views)": result["mean"]} | {
        f"{k} (published)": v for k, v in result["published"].items()
    }
    lines = [f"{'':28s}" + "".join(f"{n:>9s}" for n in names)]
    for label, values in rows.items():
        cells = (f"{values[n]:9.4f}" if n in values else f"{'':9s}" for n in names)
        lines.append(f"{label:28s}" + "".join(cells))
    return "\n".join(lines)


def _summary(result):
    """What tau changed, where it did; points, work and time."""
    lines, points, computed = [], result["points"], result["computed_fraction"]
    if "tau_bound" in result["per_image"][0]:
        bound, features, image = (
            max(row[name] for row in result["per_image"])
            for name in ("tau_bound", "tau_feature_error", "tau_picture_error")
        )
        lines.append(
            f"raster.tau: dropped at most {bound:.1e} of a pixel; features off by {features:.1e} of"
            f" their range, the image by {image:.1e}"
        )
    share = f"{computed:.0%} of the network's work, " if computed < 1 else ""
    lines.append(
        f"{points['final']} of {points['initial']} points, {share}"
        f"{result['seconds_per_frame'] * 1e3:.0f} ms per frame on {result['device']}"
    )
    return "\n".join(lines)
