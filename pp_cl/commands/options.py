"""Options that commands share, and the reading of their texts."""

import argparse
import math
import sys
import webbrowser
from collections.abc import Callable, Iterable
from pathlib import Path

from pp_cl.config import assign, preset, validate
from pp_cl.errors import UserError
from pp_cl.presets import SHORT

MOST_DIGITS = 12
METRICS = ("psnr", "ssim", "lpips")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add --device."""
    parser.add_argument(
        "--device", metavar="D", help="index or part of a name, as `pp-cl devices` prints them"
    )


def add_tolerance(parser: argparse.ArgumentParser) -> None:
    """Add --tolerance, for read_tolerance."""
    parser.add_argument(
        "--tolerance", metavar="E", help="relative L2 error allowed for a convolution (1e-5)"
    )


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """Add --metrics, for read_metrics."""
    parser.add_argument(
        "--metrics",
        nargs="?",
        const=",".join(METRICS),
        default="psnr,ssim",
        metavar="A,B",
        help="of psnr, ssim, lpips; bare = all three (default psnr,ssim)",
    )


def add_masks(parser: argparse.ArgumentParser) -> None:
    """Add --masks and --mask-from, for read_short."""
    parser.add_argument(
        "--masks", metavar="FOLDER", help="masks named like the photographs, white on the object"
    )
    parser.add_argument(
        "--mask-from",
        metavar="HOW",
        help="given (default), alpha, color (a uniform background), box or none",
    )


def refuse_empty(options: argparse.Namespace) -> None:
    """Raise UserError for an option that was given without a word, as by a shell's variable that is
    not set: it would read as not given, or as the present folder.
    """
    for name, value in vars(options).items():
        if value == "":
            option = "RUN" if name == "run_folder" else f"--{name.replace('_', '-')}"
            raise UserError(f"{option}: is empty; give a name, or leave it out")


def read_short(options: argparse.Namespace, names: Iterable[str]) -> list[tuple[str, str, str]]:
    """[(key, text, origin)] of the settings with these short names that were given."""
    texts = {name: getattr(options, name) for name in names}
    return [
        (SHORT[name], text, f"--{name.replace('_', '-')}")
        for name, text in texts.items()
        if text is not None
    ]


def read_tolerance(text: str | None) -> float | None:
    """The number of --tolerance; None where it was not given. Raises UserError naming it."""
    if text is None:
        return None
    config = preset("tiny")
    assign(config, "network.tolerance", text, "--tolerance")
    validate(config, "--tolerance")
    return config.network.tolerance


def read_blocks(text: str) -> str:
    """The word of --blocks. Raises UserError naming it."""
    config = preset("tiny")
    assign(config, "network.blocks", text, "--blocks")
    validate(config, "--blocks")
    return config.network.blocks


def read_metrics(text: str) -> tuple[str, ...]:
    """The names of --metrics. Raises UserError for unknown ones."""
    names = tuple(n.strip() for n in text.split(",") if n.strip())
    if not names or set(names) - set(METRICS):
        raise UserError(f"--metrics {text}: choose from {', '.join(METRICS)}")
    return names


def add_open(parser: argparse.ArgumentParser) -> None:
    """Add --open, for show."""
    parser.add_argument(
        "--open", action="store_true", help="show the written picture with the system's viewer"
    )


def show(path: Path | str) -> None:
    """Open a picture with the system's viewer, or say that there is none."""
    if not webbrowser.open(Path(path).resolve().as_uri()):
        print(f"--open: this system names no viewer; open {path} yourself", file=sys.stderr)


def whole(text: str) -> int:
    """The whole number from 0 on in a text of at most MOST_DIGITS digits; -1 for anything else."""
    return int(text) if text.isdecimal() and len(text) <= MOST_DIGITS else -1


def read_shape(size: str, widths: str) -> tuple[int, tuple[int, ...]]:
    """(side, channels of the three levels) of the texts of --size and --widths. Raises UserError
    for what the network cannot have.
    """
    side = whole(size)
    if side < 4 or side % 4:
        raise UserError(f"--size {size}: the network takes multiples of 4")
    numbers = [whole(n) for n in widths.split(",")]
    if len(numbers) != 3 or min(numbers) < 1:
        raise UserError(f"--widths {widths}: write three numbers of channels, as 128,256,512")
    return side, tuple(numbers)


def add_set(parser: argparse.ArgumentParser, text: str) -> None:
    """Add --set, for read_set. text: its help."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help=text
    )


def read_set(texts: list[str]) -> list[tuple[str, str, str]]:
    """[(key, value, origin)] of the texts of --set. Raises UserError for one without =."""
    given = []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise UserError(f"--set {text}: write --set section.key=value")
        given.append((key.strip(), value.strip(), "--set"))
    return given


def read_number(
    option: str, text: str, kind: Callable[[float], float], *, least: float, most: float
) -> float:
    """The one number of an option. Raises UserError naming it."""
    numbers = read_numbers(option, text, kind, least=least, most=most)
    if len(numbers) > 1:
        raise UserError(f"{option} {text}: write one number")
    return numbers[0]


def read_numbers(
    option: str, text: str, kind: Callable[[float], float], *, least: float, most: float
) -> list:
    """Numbers of a comma-separated option, ascending, each once. Raises UserError naming it."""
    try:
        numbers = sorted({kind(float(word)) for word in text.split(",")})
    except (ValueError, OverflowError):
        numbers = []
    if not numbers or not all(math.isfinite(x) and least <= x <= most for x in numbers):
        raise UserError(
            f"{option} {text}: write numbers from {least:g} to {most:g}, separated by commas"
        )
    return numbers
