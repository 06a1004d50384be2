"""The command pp-cl train."""

import argparse
import sys
from contextlib import nullcontext

from pp_cl.commands import options as shared
from pp_cl.config import help_lines
from pp_cl.presets import PRESETS, SHORT

HELP = "learn a scene; the same command resumes an unfinished run"
EPILOG = "settings (--set), with the tiny preset's values:\n" + "\n".join(help_lines())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("scene", metavar="SCENE", help="folder with transforms_train.json, or the word demo")
    add("--out", required=True, metavar="RUN", help="folder of the run")
    add(
        "--preset",
        choices=PRESETS,
        help=(
            "tiny (default): 200x200, minutes on a CPU; small: 400x400 and full: 800x800, longer;"
            " paper: the paper's numbers"
        ),
    )
    add("--iterations", metavar="N", help="steps of training")
    add("--points", metavar="N", help="wanted points on the grid")
    add("--downscale", metavar="K", help="reduce the images K times (demo: 2, others: 1)")
    add("--seed", metavar="S", help="of everything random (0)")
    add(
        "--memory",
        metavar="GIB",
        help="device memory to use; what is not needed caches the hits of repeating views",
    )
    add("--view", action="store_true", help="look on in the browser, as with `pp-cl view RUN`")
    shared.add_tolerance(parser)
    shared.add_set(parser, "any other setting, see below")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Train, or say that there is nothing left to train."""
    from pp_cl.device.discover import open_device
    from pp_cl.files.run_folder import RunFolder
    from pp_cl.run import open_training, run_config, stored_state
    from pp_cl.training.memory import plan_lines
    from pp_cl.view.serve import serve_in_background

    folder = RunFolder(options.out)
    config = run_config(folder, options.scene, options.preset, _given_settings(options))
    for note in config.notes:
        print(f"pp-cl: {note}", file=sys.stderr)
    stored = stored_state(folder, config)
    if stored and stored[0]["finished"]:
        print(
            f"{folder} is finished ({stored[0]['step']} steps); `pp-cl eval {folder} --metrics`"
            " measures it"
        )
        return
    dev = open_device(options.device)
    print(f"device: {dev.name} [{dev.info['platform']}]")
    training = open_training(dev, folder, config, stored)
    print(training.origin)
    print(_first_line(training))
    print("\n".join(plan_lines(training.plan, dev)))
    with serve_in_background(folder.path, options.device) if options.view else nullcontext():
        seconds = _run_with_bar(training)
    print(
        f"trained {config.train.iterations} steps in {seconds:.1f} s;"
        f" {training.trainer.model.cloud.count} of {training.info['initial_points']} points remain;"
        f" wrote {folder.checkpoint}"
    )


def _given_settings(options):
    """[(key, text, origin)] of every setting on the command line."""
    texts = {name: getattr(options, name) for name in SHORT}
    given = [(SHORT[name], text, f"--{name}") for name, text in texts.items() if text is not None]
    return given + shared.read_set(options.set)


def _first_line(training):
    """What the training begins with: a grid, or a checkpoint."""
    from pp_cl.scene.hull import CELL_CAP

    hull = training.hull
    if hull is None:
        trainer = training.trainer
        return f"resuming at step {trainer.step} with {trainer.model.cloud.count} points"
    near, far = hull.depth_range
    asked = training.config.points.count
    capped = (
        f"\nhull: only {hull.points} of the {asked} points asked for, since a finer grid would have"
        f" more than {CELL_CAP} cells"
    )
    return (
        f"hull: {hull.points} points on a {'x'.join(map(str, hull.dims))} grid, edge"
        f" {hull.edge:.6g} ({hull.spacing:.2f} pixels), depth {near:.3f} to {far:.3f}"
        f" ({hull.seconds:.1f} s)"
        f"{capped if hull.capped else ''}"
    )


def _run_with_bar(training):
    """Seconds of the training, run under a progress bar."""
    from tqdm import tqdm

    bar = tqdm(
        total=training.config.train.iterations,
        initial=training.trainer.step,
        unit="step",
        delay=1e-6,  # shows from the first step on, not above an error before it
        mininterval=1 if sys.stderr.isatty() else 30,
        file=sys.stderr,
    )

    def on_step(_step, row):
        bar.update()
        if row:
            bar.set_postfix(psnr=f"{row['psnr']:.2f}", points=row["points"], refresh=False)

    with bar:
        return training.run(on_step)
