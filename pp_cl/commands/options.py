"""Options that commands share, and argparse's types: functions of the text."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from pp_cl import config
from pp_cl.errors import UserError, quoted, suggestion
from pp_cl.files.atomic import check_target, write_json
from pp_cl.presets import SHORT

METRICS = ("psnr", "ssim", "lpips")
MOST_SIDE = 8192  # pixels of an image that is rendered
# N for all others
METAVARS = {"masks": "FOLDER", "ignore": "FOLDER", "mask_from": "HOW", "network": "RUN"}

# ---- types


def integer(least: int, most: int, multiple: int = 1) -> Callable[[str], int]:
    """The type of a whole number in [least, most] that is a multiple of `multiple`."""
    which = f"a multiple of {multiple}" if multiple > 1 else "a whole number"
    accepted = range(-(-least // multiple) * multiple, most + 1, multiple)
    return _read(config.whole, lambda n: n in accepted, f"{which} from {least} to {most}")


def number(least: float, most: float) -> Callable[[str], float]:
    """The type of a finite number in [least, most]."""
    what = f"one number from {least:g} to {most:g}"
    return _read(config.finite, lambda x: least <= x <= most, what)


def _read(convert, accepts, what):
    """The type of values that `accepts` allows. what: how to write them."""

    def read(text):
        try:
            value = convert(text)
            if accepts(value):
                return value
        except (ValueError, OverflowError):
            pass
        raise UserError(f"{quoted(text)}: write {what}")

    return read


def several(one: Callable[[str], Any]) -> Callable[[str], list]:
    """The type of values of another type, separated by commas: sorted, without duplicates."""
    return lambda text: sorted({one(word) for word in text.split(",")})


def words(known: Sequence[str]) -> Callable[[str], tuple[str, ...]]:
    """The type of known words, separated by commas: in the given order, without duplicates."""

    def read(text):
        given = tuple(dict.fromkeys(word.strip() for word in text.split(",")))
        for word in (word for word in given if word not in known):
            near = suggestion(word, known)
            raise UserError(f"{quoted(word)}: {near}choose from {', '.join(known)}")
        return given

    return read


def _parts(text, separator, part_type, count, what):
    """`count` values of another type. what: how to write them."""
    parts = text.split(separator)
    if len(parts) != count:
        raise UserError(f"{quoted(text)}: write {what}")
    return [part_type(part) for part in parts]


def widths(text: str) -> tuple[int, ...]:
    """The type of the channels of the network's three levels."""
    what = "three numbers of channels, as 128,256,512"
    return tuple(_parts(text, ",", integer(1, 4096), 3, what))


def box(text: str) -> list[float]:
    """The type of a box: six numbers, two corners that differ in x, y and z."""
    what = "two corners, as -1,-1,-1,1,1,1"
    corners = _parts(text, ",", number(-1e6, 1e6), 6, what)
    if any(a == b for a, b in zip(corners[:3], corners[3:], strict=True)):
        raise UserError(f"{quoted(text)}: write {what}")
    return corners


def size(text: str) -> tuple[int, int]:
    """The type of (width, height) of an image."""
    what = f"WIDTHxHEIGHT, each from 16 to {MOST_SIDE}"
    width, height = _parts(text.lower(), "x", integer(16, MOST_SIDE), 2, what)
    return width, height


def output_file(*suffixes: str) -> Callable[[str], str]:
    """The type of a file to be written, which ends in one of these suffixes if there are any."""

    def read(text):
        path, folder = Path(text), os.path.dirname(os.path.abspath(text))
        if suffixes and path.suffix.lower() not in suffixes:
            raise UserError(f"{quoted(text)}: name a file that ends in {' or '.join(suffixes)}")
        if os.path.exists(path) and not os.path.isfile(path):
            raise UserError(f"{quoted(text)}: is no file; name one")
        if not os.path.isdir(folder):
            raise UserError(f"{quoted(text)}: there is no folder {folder}; make it first")
        check_target(path)
        return text

    return read


# ---- options


def refuse(options: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise UserError if an option out of `names` was given. why: the reason, for the message."""
    for name in names:
        value = getattr(options, name)
        if not (value is None or value is False or value == []):
            raise UserError(f"--{name.replace('_', '-')}: {why}; leave it out")


def add_json(parser: argparse.ArgumentParser, known: Container[str] = ()) -> None:
    """Add --json: a file, or sys.stdout, which then gets only the JSON: cli.main() sends all other
    output to stderr. known: words of the command, which cannot be names of files.
    """

    def target(text):
        if text == "-":
            return sys.stdout
        is_taken = text in known or os.path.isdir(text)
        if not is_taken:
            output_file()(text)  # it refuses pipes, on which reading would wait
            with suppress(OSError), open(text, "rb") as file:
                # content that is no JSON would be lost
                is_taken = file.read(1) not in (b"", b"{", b"[")
        if is_taken:
            raise UserError(
                f"{quoted(text)}: no JSON may be written there; name another FILE, or write what"
                " the command works on before --json"
            )
        return text

    parser.add_argument(
        "--json",
        nargs="?",
        const="-",
        type=target,
        metavar="FILE",
        help="write the result to FILE as JSON; without FILE (or -) print it in place of the text",
    )


def write_json_option(target: str | TextIO | None, value: Any) -> None:
    """Write the result to the target of --json, if it was given."""
    if isinstance(target, str):
        write_json(target, value)
    elif target is not None:
        print(json.dumps(value, indent=1, allow_nan=False), file=target, flush=True)


def tell(target: str | TextIO | None, value: Any, lines: Iterable[str]) -> None:
    """Write the result as write_json_option() does, and print the lines unless JSON is printed."""
    write_json_option(target, value)
    if target is None or isinstance(target, str):
        print("\n".join(lines))


def add_run_scene(parser: argparse.ArgumentParser) -> None:
    """Add --scene for a command that works on a run."""
    parser.add_argument(
        "--scene", metavar="SCENE", help="where the run's scene is now, if it has moved"
    )


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add --device."""
    parser.add_argument(
        "--device", metavar="D", help="index or part of a name, as `pp-cl devices` prints them"
    )


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """Add --metrics."""

    def names(text):
        if os.path.exists(text):
            raise UserError(f"{quoted(text)}: write it before --metrics")
        return words(METRICS)(text)

    parser.add_argument(
        "--metrics",
        nargs="?",
        const=",".join(METRICS),
        default="psnr,ssim",
        type=names,
        metavar="A,B",
        help="out of psnr, ssim, lpips; without names all three (default psnr,ssim)",
    )


def add_short(parser: argparse.ArgumentParser, names: Iterable[str]) -> None:
    """Add the options for settings with short names, which read_short() reads."""
    for name in names:
        item = config.field_of(SHORT[name])
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            metavar=METAVARS.get(name, "N"),
            help=item.metadata["help"].replace("%", "%%"),
        )


def read_short(options: argparse.Namespace, names: Iterable[str]) -> list[tuple[str, str, str]]:
    """[(key, text, origin)] of the settings with these short names that were given."""
    texts = {name: getattr(options, name) for name in names}
    return [
        (SHORT[name], text, f"--{name.replace('_', '-')}")
        for name, text in texts.items()
        if text is not None
    ]


def add_set(parser: argparse.ArgumentParser, text: str) -> None:
    """Add --set: [(key, text of the value, origin)]. text: its help."""
    parser.add_argument(
        "--set", action="append", default=[], type=_setting, metavar="SECTION.KEY=VALUE", help=text
    )


def _setting(text):
    key, equals, value = text.partition("=")
    if not equals:
        raise UserError(f"{quoted(text)}: write section.key=value")
    return key.strip(), value.strip(), "--set"
