"""`pp-cl compress`: makes a trained model smaller within a stated loss of quality."""

import argparse
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "make a trained model smaller within a stated loss"
EPILOG = """Coefficients of 16 bits, and fewer points, those that weigh least in any training view
going first, as long as the views below lose no more. The loss is measured on the split val, without
one on every eighth training view; never on the test views. Without the scene it is estimated from
the run's own renderings of these."""


def _decibels(text):
    """The type of --max-loss."""
    return shared.number(0, 20)(text.removesuffix("dB"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folder", metavar="RUN", help="folder of a finished run")
    add(
        "--max-loss",
        type=_decibels,
        metavar="DB",
        default=0.1,
        help="the most that PSNR may lose, in dB, as 0.1 or 0.1dB (0.1)",
    )
    add("--out", metavar="DIR", help="new folder of the compressed run (RUN-compressed)")
    shared.add_run_scene(parser)
    add("-v", "--verbose", action="store_true", help="also print what is tried")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Search, write the compressed run, print what it saves and loses."""
    from tqdm import tqdm

    from pp_cl.compress.reduction import REPORT, Original
    from pp_cl.compress.search import search, validation_views
    from pp_cl.device.discover import open_device
    from pp_cl.files.atomic import check_new_folder
    from pp_cl.run import load_run

    out = Path(options.out or f"{Path(options.run_folder).resolve()}-compressed")
    check_new_folder(out)
    whole = load_run(open_device(options.device), options.run_folder, scene=options.scene)
    if not whole.header["finished"]:
        raise UserError(f"{whole.folder}: its training is not finished; finish it first")
    which, views, error = validation_views(whole)
    original = Original(whole)
    steps, trials = search(original, views, options.max_loss, error), []
    before = found = next(steps)
    if options.verbose:
        print(f"{which}: {before.psnr:.2f} dB, may lose {options.max_loss:g}", flush=True)
    for trial in tqdm(steps, "searching", unit="trial", leave=False, disable=None):
        trials.append(trial)
        found = trial if trial.taken else found
        if options.verbose:
            state = "taken" if trial.taken else "loses too much"
            tqdm.write(f"{trial}: {trial.psnr:.3f} dB, {trial.nbytes / 2**20:.1f} MiB, {state}")
    report = {
        "of": str(whole.folder),
        "most_loss": options.max_loss,
        "views": which,
        "psnr": before.psnr,
        "loss": found.loss,
        "bytes": [before.nbytes, found.nbytes],
        "points": [before.points, found.points],
        "device": whole.dev.name,
        "trials": [vars(trial) for trial in trials],
    }
    original.write(found.keep, found.half, out, report)
    print(
        f"{before.nbytes / 2**20:.1f} to {found.nbytes / 2**20:.1f} MiB"
        f" ({before.nbytes / found.nbytes:.1f} times less), {before.points} to {found.points}"
        f" points, {found.loss:.3f} dB lost on {which}"
    )
    print(f"wrote {out} and {out / REPORT}; pp-cl eval {out} measures its test views")
