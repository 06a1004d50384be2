"""`pp-cl train`: trains a scene into the folder of a run, or resumes the training there."""

import argparse
import importlib
import math
import signal
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

from pp_cl.commands import COMMANDS
from pp_cl.commands import options as shared
from pp_cl.config import begin_with, help_lines, load_config
from pp_cl.errors import UserError, pasted, require
from pp_cl.presets import PRESETS, SHORT

if TYPE_CHECKING:
    from pp_cl.session.training import Training

HELP = "learn a scene; the same command resumes an unfinished run"
EPILOG = "\n".join(("settings (--set), with tiny's values and those that differ:", *help_lines()))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("scene", metavar="SCENE", nargs="?", help="folder of a scene, or the word demo (RUN's own)")
    add("--out", required=True, metavar="RUN", help="folder of the run")
    add(
        "--preset",
        choices=PRESETS,
        help="tiny: images of about 200 pixels, minutes on a CPU; small: of 400, and full: of up to"
        " 1600, made for 800, longer; best: the mean of two such; paper: the paper's numbers (if"
        " neither this nor --iterations is given: by --minutes, 10, and the device; else tiny)",
    )
    add(
        "--config",
        metavar="FILE",
        help="begin with the settings of a config.json, all but those of its scene and the"
        " automatic ones; options come on top",
    )
    shared.add_short(parser, SHORT)
    add(
        "--tensorboard",
        action="store_true",
        help="also write the curves to RUN/tensorboard (needs tensorboardX)",
    )
    add("--view", action="store_true", help="watch in the browser, live between steps")
    shared.add_set(parser, "any other setting, listed by --help")
    shared.add_device(parser)


def run(options: argparse.Namespace, follow: Callable[["Training"], None] = lambda _: None) -> None:
    """Train, or say that there is nothing left to train. follow: called with each training before
    its first step.
    """
    from pp_cl.files.run_folder import RunFolder
    from pp_cl.session.decide import config_of
    from pp_cl.session.training import members

    if options.view:
        require("the viewer", "viser")
    if options.tensorboard:
        require("--tensorboard", "tensorboardX")
    folder = RunFolder(options.out)
    given, is_new = shared.read_short(options, SHORT) + options.set, not folder.config.exists()
    preset = options.preset
    if options.config:
        if preset:
            raise UserError("--preset: --config has one already; leave one of them out")
        preset, given = begin_with(options.config, given)
    if options.scene is None and is_new:
        raise UserError("SCENE: name the folder of a scene, or the word demo")
    scene = options.scene or load_config(folder.config).scene.path
    config = config_of(folder, scene, preset, given, options.device)
    for member_folder, member_config in members(folder, config):
        if member_folder is not folder:
            print(f"a training with the next seed, in {member_folder}")
        _train(member_folder, member_config, options, follow)


def _train(folder, config, options, follow):
    """Train one run."""
    from pp_cl.drivers import device_line, open_device
    from pp_cl.engine.training.schedule import refinements
    from pp_cl.session.training import is_finished, open_training, stored_state

    stored = stored_state(folder, config)
    if stored and is_finished(stored, config):
        print(
            f"{folder} is finished ({stored[0]['step']} steps); `pp-cl eval {pasted(folder)}"
            " --metrics` measures it"
        )
        return
    dev = open_device(options.device)
    print(device_line(dev, options.device))
    training = open_training(dev, folder, config, stored)
    follow(training)
    train = training.config.train
    print(_images_line(training))
    print(*_first_lines(training), sep="\n")
    if begun := training.trainer.begun:
        print(
            f"extends a finished training of {begun} steps; {train.iterations} from the"
            " start would differ, as all schedules end at the last step and the optimiser's"
            " moments start again"
        )
    wanted = sum(0 < share < 1 for share in train.refine_at)
    if training.hull and (made := len(refinements(train))) < wanted:
        print(
            f"refinements: {made} of the {wanted} of train.refine_at, since in"
            f" {train.iterations} iterations nothing is pruned between them"
        )
    print(training.memory_line(), flush=True)
    seconds = _run(training, options)
    if fitted := training.trainer.fitted:
        print(_specular_line(fitted))
    print(
        f"trained {training.config.train.iterations} steps in {seconds:.1f} s;"
        f" {training.trainer.model.cloud.count} points"
        f" ({training.info['initial_points']} at the start);"
        f" wrote {folder.checkpoint}"
    )


def _first_lines(training):
    """Lines of text: what a new training has decided, or the step that another resumes at."""
    hull, trainer = training.hull, training.trainer
    if hull is None:
        return [f"resuming at step {trainer.step} with {trainer.model.cloud.count} points"]
    of_masks = (
        f"masks: they contradict each other; up to {hull.forgiven} of {len(trainer.views)} may"
        " reject a point"
    )
    return [*training.config.decisions.values(), *[of_masks] * (hull.forgiven > 0)]


def _specular_line(fitted):
    """A line of text: how much the specular layer improves the image."""
    if fitted.layer is None:
        return "specular: left out, it explains too little of views that it is not fitted to"
    before, after = (-10 * math.log10(max(mse, 1e-10)) for mse in (fitted.before, fitted.after))
    return (
        f"specular: kept at {fitted.scale:.2f}; the object in training views"
        f" {before:.2f} -> {after:.2f} dB"
    )


def _images_line(training):
    """A line of text: the size of the images."""
    views = training.trainer.views
    stored = _sizes([view.file_camera for view in views])
    used = _sizes([view.camera for view in views])
    return f"images: {stored}" if stored == used else f"images: scaled from {stored} to {used}"


def _sizes(cameras):
    """WxH of the cameras' images; if they differ, of the smallest and of the largest."""
    sizes = sorted({(c.width, c.height) for c in cameras}, key=math.prod)
    return " to ".join(f"{w}x{h}" for w, h in dict.fromkeys((sizes[0], sizes[-1])))


def _run(training, options):
    """Run the training; returns its seconds. Raises Stopped after Ctrl-C or SIGTERM: at once in the
    first step, which builds kernels, later at the end of the step.
    """
    from pp_cl.commands.progress import TrainingProgress
    from pp_cl.commands.signals import first_signal
    from pp_cl.errors import Stopped
    from pp_cl.files.scalars import curves

    trainer, folder = training.trainer, training.folder
    with ExitStack() as stack:
        followers = [stack.enter_context(TrainingProgress(training))]
        if options.tensorboard:
            drawn = curves(folder.path / "tensorboard", trainer.step)
            followers.append(stack.enter_context(drawn))
        if options.view:
            viewer = importlib.import_module(COMMANDS["view"])
            followers.append(stack.enter_context(viewer.following(training)))
        first, caught = trainer.step + 1, []

        def on_step(step, row):
            nonlocal caught
            if step == first:
                caught = stack.enter_context(first_signal())
            for follower in followers:
                follower(step, row)

        try:
            seconds = training.run(on_step, lambda: bool(caught))
        except KeyboardInterrupt as signalled:
            number, *_ = signalled.args or [signal.SIGINT]
            resumes = "goes on from" if folder.checkpoint.exists() else "starts over, there is no"
            raise Stopped(
                f"stopped at once; the same command {resumes} {folder.checkpoint}", 128 + number
            ) from None
    if caught:
        is_finished = trainer.progress >= 1
        goes_on = "the training is finished" if is_finished else "the same command goes on"
        raise Stopped(
            f"stopped at step {trainer.step}; wrote {folder.checkpoint}; {goes_on}",
            128 + caught[0],
        )
    return seconds
