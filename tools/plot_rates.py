"""Draw the learning rates of the SH degrees over a training: Figure 2 of the supplemental.

    python tools/plot_rates.py rates.png --preset paper

On the left the whole training, on the right its beginning, where higher degrees warm up. The curves
are the rates that a training with the preset takes. Needs the extra `plot`.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from pp_cl.bench.plots import figure_of, save_figure
from pp_cl.commands.options import figure_file
from pp_cl.config import Config, preset
from pp_cl.errors import UserError
from pp_cl.presets import PRESETS
from pp_cl.training.schedule import Rates

SAMPLES = 501  # of a curve


def sh_rates(config: Config, steps: Sequence[int]) -> np.ndarray:
    """(len(steps), 3): the learning rates of SH degrees 0, 1, 2 at steps of a training."""
    return np.array([Rates.at(int(step), config.network, config.train).sh for step in steps])


def spans(config: Config) -> list[np.ndarray]:
    """The steps of both curves: of the whole training, and of twice the longest warm-up."""
    last = config.train.iterations
    begin = min(last, 2 * round(max(config.train.sh_delay) * last)) or last
    return [np.unique(np.linspace(0, end, SAMPLES).round().astype(int)) for end in (last, begin)]


def draw(figure, config):
    """Fill a matplotlib figure."""
    for place, steps in enumerate(spans(config)):
        axes = figure.add_subplot(1, 2, place + 1, xlabel="step", ylabel="learning rate")
        axes.set_yscale("log")
        for degree, rates in enumerate(sh_rates(config, steps).T):
            axes.plot(steps, rates, label=f"degree {degree}")
    figure.suptitle(f"SH learning rates, preset {config.preset}")


def main(arguments: list[str] | None = None) -> int:
    """The exit status: 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=figure_file, metavar="OUT", help="a .png, .svg or .pdf file")
    parser.add_argument("--preset", choices=PRESETS, default="paper", help="(paper)")
    options = parser.parse_args(arguments)
    try:
        figure = figure_of(options.out, "OUT")
        draw(figure, preset(options.preset))
        save_figure(figure, options.out)
    except UserError as error:
        print(f"plot_rates: {error}", file=sys.stderr)
        return 2
    print(f"wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
