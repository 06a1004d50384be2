"""Write docs/road.md: what a default training step calls, in reading order.

    python -m tools.road            # or make docs

A step is traced on a CPU. Functions and kernel files are listed where they are first called; a
minute is 40 lines of code, without blank lines, comments and docstrings.
"""

import ast
import gc
import io
import operator
import re
import sys
import tempfile
import tokenize
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from pp_cl.config import run_config
from pp_cl.drivers import open_device
from pp_cl.engine.device.device import Device, kernel_folder
from pp_cl.engine.step import Trainer
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.training import open_training
from tools.provenance import ROOT

FILE = ROOT / "docs" / "road.md"
ENGINE = ROOT / "pp_cl" / "engine"
LINES_A_MINUTE = 40
SETTINGS = {
    "points.count": 2000,
    "scene.downscale": 4,
    "train.iterations": 1000,
    "train.refine_at": (1.0, 1.0),
}
WARM = 4  # steps in which buffers grow and kernels are built
LEAST_LINES = 5  # of a listed function; shorter ones are explained by their names
HEAD = """# The road: one step, in the order to read it

What `Trainer.train_step` calls in a default training on a CPU, once its buffers are there:
functions of `pp_cl/engine/` from {least} lines of code on and files of `cl/`, of headers those that
the step's kernels are built with. They stand where they come first, after the minutes of reading up
to their end, at {pace} lines a minute. `make docs` traces a step and writes this page;
[architecture.md](architecture.md#a-training-step) says what the parts do.

"""
# an #include, and the condition of an #if or #elif right above it
INCLUDE = r'(?m)^(?:#(?:el)?if (\w+)(?: (==|<|>) (\w+))?\n)?#include "(.+)"'
RELATIONS = {"": operator.ne, "==": operator.eq, "<": operator.lt, ">": operator.gt}
Step = tuple[Path, str]  # (a file, a function in it; "" for a file of kernels)


def traced(dev: Device) -> list[Step]:
    """The functions and kernel files that one step uses, in the order of first use."""
    given = [(*item, "road") for item in SETTINGS.items()]
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder(Path(folder) / "run")
        trainer = open_training(dev, run, run_config(run, "demo", None, given), None).trainer
        for _ in range(WARM):
            trainer.train_step()
        forget_calls(trainer)
        return called(trainer.train_step)


def forget_calls(trainer: Trainer) -> None:
    """Make the next step call the functions that it would replay."""
    trainer.renderer._buffers.calls.clear()
    trainer.model.net.release()


def called(function: Callable[[], object]) -> list[Step]:
    """Call a function; returns the engine's functions and kernel files that it uses."""
    steps: dict[Step, None] = {}

    def watch(frame, event, _):
        code = frame.f_code
        path = Path(code.co_filename)
        if event == "call" and ENGINE in path.parents and not code.co_name.startswith("<"):
            steps[path, code.co_name] = None
            if code.co_name == "program":
                name, macros = frame.f_locals["name"], frame.f_locals["defines"]
                for file in kernel_files(kernel_folder() / f"{name}.cl", macros):
                    steps[file, ""] = None

    gc.disable()  # its callbacks for unrelated arrays would be listed
    sys.setprofile(watch)
    try:
        function()
    finally:
        sys.setprofile(None)
        gc.enable()
    return [*steps]


@cache
def python_lines(path: Path) -> dict[str, int]:
    """{function or method: its lines of code}; a name counts where it first occurs."""
    text = path.read_text("utf-8")
    skipped = {getattr(tokenize, kind) for kind in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT")}
    code = {
        line
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in skipped
        for line in range(token.start[0], token.end[0] + 1)
    }
    counts: dict[str, int] = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            doc = node.body[0] if ast.get_docstring(node) else None
            doc_lines = range(doc.lineno, (doc.end_lineno or 0) + 1) if doc else ()
            lines = code & {*range(node.lineno, (node.end_lineno or 0) + 1)} - {*doc_lines}
            counts.setdefault(node.name, len(lines))
    return counts


def kernel_files(path: Path, macros: dict[str, Any]) -> list[Path]:
    """The headers that a kernel's file includes if it is built with these macros, then the file."""
    text = path.read_text("utf-8")
    values = dict(re.findall(r"(?m)^#define (\w+) (\w+)", text)) | macros

    def number(word):
        return number(values[word]) if word in values else int(word)

    headers: dict[Path, None] = {}
    for left, relation, right, name in re.findall(INCLUDE, text):
        if not left or RELATIONS[relation](number(left), number(right or "0")):
            headers |= dict.fromkeys(kernel_files(kernel_folder() / name, macros))
    return [*headers, path]


def kernel_lines(path: Path) -> int:
    """The number of lines of code in a kernel's file."""
    lines = path.read_text("utf-8").splitlines()
    return sum(bool(line.partition("//")[0].strip()) for line in lines)


def page(steps: list[Step]) -> str:
    """The text of docs/road.md."""
    rows: list[tuple[Path, list[str], int]] = []
    for path, function in steps:
        if function:
            lines = python_lines(path).get(function, 0)
            if lines < LEAST_LINES:
                continue
            if rows and rows[-1][0] == path:
                rows[-1] = path, [*rows[-1][1], function], rows[-1][2] + lines
            else:
                rows.append((path, [function], lines))
            continue
        rows.append((path, [], kernel_lines(path)))
    text, total = HEAD.format(least=LEAST_LINES, pace=LINES_A_MINUTE), 0
    for path, functions, lines in rows:
        total += lines
        name = path.relative_to(ROOT).as_posix().removeprefix("pp_cl/engine/")
        suffix = f": {', '.join(functions)}" if functions else ""
        text += f"    {total / LINES_A_MINUTE:3.0f}  {name}{suffix}\n"
    return text


def main() -> int:
    """Write the page; returns the exit status."""
    FILE.write_text(page(traced(open_device())), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
