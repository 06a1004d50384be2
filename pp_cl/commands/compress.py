"""`pp-cl compress`: makes a trained model smaller and faster within a stated loss of quality."""

import argparse
from pathlib import Path

from pp_cl.commands import options as shared
from pp_cl.errors import UserError

HELP = "make a trained model smaller and faster within a stated loss"
EPILOG = """Tried in turn, each kept where the views below lose no more: coefficients of 16 bits, no
channels of the network that are dead or hardly weigh, stopping earlier along a pixel, fewer
harmonics, and at last fewer points, those that weigh least in any training view going first. The
loss is measured on the split val, without one on every eighth training view; never on the test
views. Without the scene it is estimated from the run's own renderings of these."""
COLUMNS = "{:20s} {:>8s} {:>8s} {:>10s} {:>10s} {:>7s}  {}".format


def _decibels(text):
    """The type of --max-loss."""
    return shared.number(0, 20)(text.removesuffix("dB"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run_folder", metavar="RUN", help="folder of a finished run")
    parser.add_argument(
        "--max-loss",
        type=_decibels,
        metavar="DB",
        default=0.1,
        help="the most that PSNR may lose, in dB, as 0.1 or 0.1dB (0.1)",
    )
    parser.add_argument(
        "--out", metavar="DIR", help="new folder of the compressed run (RUN-compressed)"
    )
    shared.add_run_scene(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="also print what is tried")
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Search, write the compressed run, print what it saves and loses."""
    from pp_cl.compress.reduction import REPORT, Original, nbytes
    from pp_cl.compress.search import Search, frame_ms, validation_views
    from pp_cl.device.discover import open_device
    from pp_cl.files.atomic import check_new_folder
    from pp_cl.run import load_run

    out = Path(options.out or f"{Path(options.run_folder).resolve()}-compressed")
    check_new_folder(out)
    whole = load_run(open_device(options.device), options.run_folder, scene=options.scene)
    if not whole.header["finished"]:
        raise UserError(f"{whole.folder}: its training is not finished; finish it first")
    which, views, error = validation_views(whole)
    original = Original.of(whole)
    search = Search(original, views, options.max_loss, error)
    trials = _trials(search, which, options.verbose)
    ms, sizes = frame_ms([whole, search.run], views), [nbytes(whole), nbytes(search.run)]
    report = {
        "of": str(whole.folder),
        "most_loss": options.max_loss,
        "views": which,
        "psnr": search.psnr,
        "loss": search.loss,
        "reduction": vars(search.reduction),
        "bytes": sizes,
        "points": [whole.model.cloud.count, search.run.model.cloud.count],
        "frame_ms": ms,
        "device": whole.dev.name,
        "trials": [vars(trial) | {"reduction": vars(trial.reduction)} for trial in trials],
    }
    original.write(search.reduction, out, report)
    print(
        f"{sizes[0] / 2**20:.1f} to {sizes[1] / 2**20:.1f} MiB ({sizes[0] / sizes[1]:.1f} times"
        f" less), {1e3 / ms[0]:.1f} to {1e3 / ms[1]:.1f} frames per second"
        f" ({ms[0] / ms[1]:.2f} times), {search.loss:.3f} dB lost on {which}"
    )
    print(f"wrote {out} and {out / REPORT}; pp-cl eval {out} measures its test views")


def _trials(search, which, verbose):
    """All that is tried, told while it is: as a table, or as a count on a terminal."""
    from tqdm import tqdm

    if verbose:
        print(f"{which}: {search.psnr:.2f} dB, may lose {search.most_loss:g}")
        print(COLUMNS("tried", "PSNR", "loss", "points", "MiB", "speed", ""), flush=True)
    trials = []
    disable = True if verbose else None  # None: where there is no terminal
    with tqdm(desc="searching", unit="trial", leave=False, disable=disable) as bar:
        for trial in search.trials():
            trials.append(trial)
            bar.update()
            if verbose:
                print(_line(trial), flush=True)
    return trials


def _line(trial):
    speed = "" if trial.speed is None else f"{trial.speed:.2f}"
    return COLUMNS(
        trial.what,
        f"{trial.psnr:.3f}",
        f"{trial.loss:.3f}",
        str(trial.points),
        f"{trial.nbytes / 2**20:.1f}",
        speed,
        "taken" if trial.taken else "",
    )
