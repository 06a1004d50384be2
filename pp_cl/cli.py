"""The command line: builds the parser from the commands and turns exceptions into exit statuses."""

import argparse
import importlib
import io
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout, suppress

from pp_cl import __version__
from pp_cl.commands import COMMANDS, signals
from pp_cl.errors import BuildError, Stopped, UserError, one_line, quoted, suggestion
from pp_cl.files.atomic import mend

SIGPIPE = 13  # Windows has no name for it


class _UsageError(UserError):
    """A command line that makes no sense. The message begins with the program's name."""


class _Parser(argparse.ArgumentParser):
    """argparse with one-line errors that suggest the nearest word, and without empty values."""

    def error(self, message):
        taker = next((word for word in ("--json", "--metrics") if word in self._words), "")
        if "required" in message and taker:  # it may have taken the missing word as its value
            message += f" (write it before {taker})"
        end = " " if message.endswith("?") else "; "
        raise _UsageError(f"{self.prog}: {message}{end}see {self.prog} --help")

    def parse_known_args(self, args=None, namespace=None):
        self._words = args or ()
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            word = next((word for word in unknown if word.startswith("-")), "")
            near = suggestion(word.partition("=")[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(unknown)}; {near}".rstrip("; "))
        return options, unknown

    def _get_value(self, action, text):
        if text == "" and action.nargs != argparse.PARSER:
            raise argparse.ArgumentError(action, "is empty; write it, or leave it out")
        try:
            return super()._get_value(action, text)
        except UserError as error:  # raised by the action's type
            raise argparse.ArgumentError(action, str(error)) from None

    def _check_value(self, action, value):
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            near, all_of_them = suggestion(str(value), known), ", ".join(known)
            raise argparse.ArgumentError(
                action, f"{quoted(value)}: {near}choose from {all_of_them}"
            )

    def _print_message(self, message, file=None):
        if message:
            print(message, end="", file=file or sys.stderr, flush=True)


def program(argv: Sequence[str] | None = None) -> int:
    """main() for a process: it ends soon after Ctrl-C or SIGTERM, whatever it is doing, and accepts
    streams as shells give them: closed, full, or without a reader.
    """
    signals.watch()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    try:
        return main(argv)
    except KeyboardInterrupt as second:  # main() has reported the first
        return 128 + (second.args or [signal.SIGINT])[0]
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:  # discard the rest, which Python would try to write again and report
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    warnings.showwarning = _show_warning
    # what commands tell is not for Python's filters, which may hide it or make an error of it
    warnings.filterwarnings("default", category=UserWarning, module=r"pp_(cl|studio)\b")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # for characters that its encoding lacks
            stream.reconfigure(errors="backslashreplace")
    with signals.interrupting() as caught:
        try:
            words = sys.argv[1:] if argv is None else list(argv)
            parser = _parser(words[:1])
            if not words:
                parser.print_help()
                return 0
            options = parser.parse_args(words)
            json_alone = getattr(options, "json", None) is sys.stdout
            with redirect_stdout(sys.stderr) if json_alone else nullcontext():
                options.run(options)
            sys.stdout.flush()
            return 0
        except Stopped as stopped:
            return _fail(str(stopped), stopped.status)
        except BaseException as error:
            if caught:  # the signal may have caused any error, such as in an import
                return _fail(signals.INTERRUPTED, 128 + caught[0])
            match error:
                case _UsageError():
                    _show(str(error))
                    return 2
                case UserError():
                    return _fail(str(error))
                case BrokenPipeError():  # as in `pp-cl train ... | head`
                    return _fail("nobody reads the output any more", 128 + SIGPIPE)
                case OSError():
                    what = f"{error.filename or 'file'}: {error.strerror or error}"
                    return _fail(f"{what}; {mend(error)}")
                case BuildError():
                    print(error.log.rstrip(), file=sys.stderr)
                    return _fail(
                        f"{error}; update the driver, choose another device with --device, or"
                        " report the lines above"
                    )
                case MemoryError():
                    return _fail("the host has no memory left; lower --points or raise --downscale")
                case ImportError() if "failed to map segment" in str(error):  # the loader's words
                    return _fail(f"no memory to load a library ({error}); raise `ulimit -v`")
                case KeyboardInterrupt():
                    return _fail(signals.INTERRUPTED, 128 + signal.SIGINT)
            raise


def _show_warning(message, *_args, **_kwargs):
    """Show a warning as one line on stderr, without its place in our source."""
    _show(f"pp-cl: {one_line(message)}")


def _show(line):
    with suppress(OSError):  # a full disk is no reason to stop
        print(line, file=sys.stderr, flush=True)


def _fail(message, status=2):
    _show_warning(message)
    signals.told.set()
    return status


def _parser(first):
    """The parser of the command that the first word names, or else of all commands. first: [] or
    [word].
    """
    parser = _Parser(
        prog="pp-cl",
        description="Reconstruct an object from photographs with OpenCL.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"pp-cl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)
    for name in first if {*first} <= COMMANDS.keys() and first else COMMANDS:
        module = importlib.import_module(COMMANDS[name])
        command = commands.add_parser(
            name,
            help=module.HELP,
            description=module.HELP,
            epilog=getattr(module, "EPILOG", None),
            allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser
