"""`pp-cl eval`: renders the views of a run and measures them."""

import argparse
from pathlib import Path

from pp_cl.commands import options as shared

HELP = "render a run's views and measure them"
AFTER_COLOUR = "with each view's colour"
OTHER_LPIPS = "lpips_alex"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folder", metavar="RUN", help="folder of the run")
    shared.add_metrics(parser)
    add("--split", default="test", help="train, val or test (default)")
    add(
        "--size",
        type=shared.integer(16, 2**15),
        default=0,
        metavar="N",
        help="measure on views whose longer side has N pixels, to compare runs of different sizes",
    )
    shared.add_run_scene(parser)
    add("--out", metavar="FOLDER", help="folder to write to, instead of RUN/eval")
    add("--save-images", action="store_true", help="write every view to RUN/eval/images/")
    shared.add_json(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Evaluate, print the table."""
    from pp_cl.evaluate import evaluate_run
    from pp_cl.run import load

    run = load(options.run_folder, options.device, scene=options.scene)
    metrics, folder = options.metrics, run.folder
    result = evaluate_run(
        run,
        options.split,
        metrics,
        save_images=options.save_images,
        out=options.out,
        size=options.size,
    )
    state = "" if result["finished"] else f", unfinished, step {result['step']}"
    own = f"{folder} ({len(result['per_image'])} views"
    own += f" of {result['size'][0]}x{result['size'][1]}{state})" if options.size else f"{state})"
    published = {} if result["published_differs"] else result["published"]
    ranked = [(own, result["mean"]), *published.items()]
    if "mean_after_colour" in result:
        ranked.append((AFTER_COLOUR, result["mean_after_colour"]))
    if "psnr" in metrics:
        ranked.sort(key=lambda row: -row[1]["psnr"])
    shared.write_json_option(options.json, result)
    print(_table(result, ranked, len(own)))
    points, computed = result["points"], result["computed_fraction"]
    share = f"{computed:.0%} of the network's work, " if computed < 1 else ""
    print(
        f"{points['final']} points ({points['initial']} at the start), {share}"
        f"{result['seconds_per_frame'] * 1e3:.0f} ms per frame on {result['device']}"
    )
    written = Path(options.out or folder.evaluation(options.split, options.size))
    print(
        f"wrote {written / 'metrics.json'} and {written / 'comparison.png'} (prediction"
        " | truth | 4 x error)"
    )


def _table(result, ranked, width):
    """The run's means among the published ones, the best PSNR first. ranked: [(label, values)]."""
    names, width = list(result["mean"]), max(28, width + 2)
    lines = [f"{'':{width}s}" + "".join(f"{n:>10s}" for n in names)]
    for label, values in ranked:
        cells = (_cell(values, name) for name in names)
        lines.append(f"{label:{width}s}" + "".join(cells).rstrip())
    if "lpips" in names and any(OTHER_LPIPS in values for _, values in ranked):
        lines.append("* LPIPS by AlexNet, which cannot be compared with the others, by VGG16")
    return "\n".join(lines)


def _cell(values, name):
    if name == "lpips" and OTHER_LPIPS in values:
        return f"{values[OTHER_LPIPS]:9.4f}*"
    return f"{values[name]:9.4f} " if name in values else " " * 10
