"""Write the generated parts of README.md and docs/: tables of measurements, settings, commands.

    python -m tools.docs_tables            # or make docs

A generated part stands between the lines `<!-- table: NAME -->` and `<!-- end table -->` of a
Markdown file. NAME is `settings` (from pp_cl/settings.py and presets.py), `commands` (from the
parsers of pp_cl/commands/), `api` (the public names), `trained` and `evaluated` (what the commands
of README.md print, from docs/results/readme.json), `kinds` (all tables in folders of docs/results/
that have no marker of their own), or the name of another file docs/results/NAME.json (NAME may be
KIND/TABLE), which holds

    commit, date, machine, how    which code was measured, when, where and how
    decides    digest of the files that decide a training in that code (tools/provenance.py)
    measured   what the numbers are
    columns    [{"head": text, "cell": format}]: format is a str.format of the row's keys
    rows       [{key: value}]; a cell is empty if the row lacks one of its keys
    is_plain   if true, the table is shown as on a terminal
"""

import argparse
import ast
import importlib
import inspect
import json
import re
import string
import sys
import textwrap
from collections.abc import Collection, Sequence
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, get_origin

from pp_cl.commands import COMMANDS
from pp_cl.config import text_of
from pp_cl.presets import PRESETS, SHORT
from pp_cl.settings import Config, every_setting
from tools.provenance import ROOT, sentence

# the modules whose names other packages may import; pp_studio imports from no others
PUBLIC = (
    "pp_cl",
    *(f"pp_cl.{name}" for name in ("engine", "scene", "files", "config", "errors")),
    *(f"pp_cl.{name}" for name in ("commands", "commands.options", "commands.signals")),
    "pp_studio",
)
TOLD = ("pp_cl", "pp_studio")
BLOCK = re.compile(r"^(<!-- table: (\S+) -->\n).*?^(<!-- end table -->)$", re.DOTALL | re.MULTILINE)
MARKER = re.compile(r"^<!-- (?:end )?table", re.MULTILINE)


class TableError(Exception):
    """A marker or a file of results is wrong; the message says how."""


def cell(template: str, row: dict) -> str:
    """The template filled from the row; empty if the row lacks one of its keys."""
    if not {name for _, name, _, _ in string.Formatter().parse(template) if name} <= row.keys():
        return ""
    text = template.format_map(row)
    text = re.sub(r"\b0\.?0*e[+]00", "0", text)  # 0.0e+00 -> 0
    return re.sub(r"e([+-])0+(\d)", r"e\1\2", text).strip()  # 1e-06 -> 1e-6


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (heads, *rows)]
    return [lines[0], "|---" * len(heads) + "|", *lines[1:]]


def plain(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table as a terminal shows it."""
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    line = "  ".join(f"{{:{width}}}" for width in widths)
    return [f"    {line.format(*cells)}".rstrip() for cells in (heads, *rows)]


def table(results: dict) -> str:
    """Markdown of a file of results: what was measured, with which code, and the table."""
    what = results["measured"]
    heads = [column["head"] for column in results["columns"]]
    rows = [[cell(column["cell"], row) for column in results["columns"]] for row in results["rows"]]
    caption = f"{what[0].upper()}{what[1:]}. *{sentence(results)}*"
    lines = plain(heads, rows) if results.get("is_plain") else markdown(heads, rows)
    return "\n".join([caption, "", *lines])


def readme(results: dict) -> dict[str, str]:
    """{"trained", "evaluated"}: the lines that README's commands print on the first driver, and a
    sentence on the other drivers.
    """
    first, *others = results["rows"]
    beside = "".join(
        f" With {row['driver']} it is {row['points']} points, and {row['psnr']}, {row['ssim']},"
        f" {row['lpips']}."
        for row in others
    )
    about = f"These lines are what the driver {first['driver']} gives with {first['kind']}.{beside}"
    lines = ["    " + line for line in first["table"]]
    return {
        "trained": f"    {first['trained']}",
        "evaluated": "\n".join([*lines, "", f"{about} {sentence(results)}"]),
    }


def kinds(tables: dict[str, str]) -> str:
    """The tables of each kind under its name; the table of trainings comes first."""
    lines: list[str] = []
    for kind in sorted({name.partition("/")[0] for name in tables if "/" in name}):
        own = sorted(name for name in tables if name.startswith(f"{kind}/"))
        own.sort(key=lambda name: not name.endswith("/trainings"))
        lines += [f"### {kind}", *(tables[name] for name in own)]
    return "\n\n".join(lines)


def settings() -> str:
    """Every setting: its value in the preset tiny and in presets that change it, and its help, or
    the option that stands for it.
    """
    lines = []
    options = {key: f"`--{name.replace('_', '-')}`" for name, key in SHORT.items()}
    for key, _, item in every_setting(Config()):
        others = [f"{n}: {text_of(c[key])}" for n, c in PRESETS.items() if key in c]
        value = "; ".join(filter(None, [text_of(item.default), *others]))
        meaning = options.get(key, item.metadata["help"])
        lines += [f"- `{key}`{f' ({value})' if value else ''}: {meaning}"]
    return "\n".join(lines)


def commands() -> str:
    """Every command with its arguments, as they are typed."""
    lines: list[str] = []
    for name in COMMANDS:
        module = importlib.import_module(COMMANDS[name])
        parser = argparse.ArgumentParser(add_help=False)
        module.add_arguments(parser)
        arguments = ", ".join(f"`{_written(action)}`" for action in parser._actions)
        lines += [f"## pp-cl {name}", "", f"{module.HELP[0].upper()}{module.HELP[1:]}.", ""]
        lines += textwrap.wrap(arguments, 160, break_long_words=False, break_on_hyphens=False)
        lines += [""]
    return "\n".join(lines).rstrip()


def api() -> str:
    """The public names of the modules in TOLD, with their signatures and the first sentence of
    their docstrings, where they first occur; then the other modules.
    """
    lines: list[str] = []
    seen: set[int] = set()
    for name in TOLD:
        module = importlib.import_module(name)
        lines += [f"## {name}", "", _first_sentence(module.__doc__), ""]
        for symbol in public_names(module):
            obj = getattr(module, symbol)
            lines += _described(symbol, obj) if id(obj) not in seen else [f"- `{symbol}`: above"]
            seen.add(id(obj))
        lines += [""]
    others = [importlib.import_module(name) for name in PUBLIC if name not in TOLD]
    lines += [
        "## Other modules",
        "",
        "In these, the names in `__all__` are public, or, without it, all that",
    ]
    lines += ["are defined there and do not begin with an underscore.", ""]
    lines += [f"- `{module.__name__}`: {_first_sentence(module.__doc__)}" for module in others]
    return "\n".join(lines)


def public_names(module: ModuleType) -> list[str]:
    """The names that others may import from a module: its __all__, or all that it defines."""
    defined = [
        n for n, v in vars(module).items() if getattr(v, "__module__", "") == module.__name__
    ]
    named = getattr(module, "__all__", defined)
    return sorted((n for n in named if n[0] != "_"), key=lambda n: (n.lower(), n))


def _first_sentence(text: str | None) -> str:
    paragraph = " ".join((text or "").strip().partition("\n\n")[0].split())
    return re.split(r"(?<=\.)\s", paragraph)[0]


def _described(name: str, obj: Any) -> list[str]:
    """The lines of a name: a constant, a type, a function, or a class with its public methods."""
    if not (inspect.isroutine(obj) or inspect.isclass(obj)):
        if isinstance(obj, (int, str)):
            return [f"- `{name} = {obj!r}`"]
        is_type = get_origin(obj) is not None
        value = re.sub(r"(collections\.abc|typing)\.", "", str(obj)) if is_type else ""
        return [f"- `{name} = {value}`" if is_type else f"- `{name}: {type(obj).__name__}`"]
    lines = [f"- `{name}{_signature(obj)}`: {_first_sentence(obj.__doc__)}"]
    members = _members(obj) if inspect.isclass(obj) else []
    return [*lines, "", *(f"        {member}" for member in members), ""] if members else lines


def _members(obj: type) -> list[str]:
    """The signatures of a class's public methods and properties; none for an error."""
    lines = []
    for name, member in vars(obj).items():
        if name[0] == "_" or name in getattr(obj, "_fields", ()) or issubclass(obj, Exception):
            continue
        if isinstance(member, (property, cached_property)):
            function = member.fget if isinstance(member, property) else member.func
            lines.append(f".{name}: {_signature(function).partition(' -> ')[2]}")
        elif isinstance(member, (classmethod, staticmethod)) or inspect.isfunction(member):
            lines.append(f".{name}{_signature(getattr(member, '__func__', member))}")
    return lines


def _signature(obj: Any) -> str:
    """The typed signature of a function, or of a class's constructor, as in the source."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(obj))).body
    if isinstance(node, ast.ClassDef):
        inits = [child for child in node.body if getattr(child, "name", "") == "__init__"]
        if not inits:  # a dataclass, a NamedTuple
            fields = [ast.unparse(child) for child in node.body if isinstance(child, ast.AnnAssign)]
            shown = [field for field in fields if field[0] != "_" and "init=False" not in field]
            return f"({', '.join(field.split(' = field(')[0] for field in shown)})" if shown else ""
        (node,) = inits
    node.args.args = [arg for arg in node.args.args if arg.arg not in ("self", "cls")]
    returned = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    text = f"({ast.unparse(node.args)}){returned}".removesuffix(" -> None")
    return re.sub(r"'([A-Z]\w+)'", r"\1", text)


def _written(action: argparse.Action) -> str:
    """An argument as it is typed, such as `--seed S`."""
    if action.nargs == 0:
        return ", ".join(action.option_strings)
    value = action.metavar or "|".join(map(str, action.choices or [action.dest.upper()]))
    value = value if isinstance(value, str) else " ".join(value)
    if not action.option_strings:
        return value
    return f"{', '.join(action.option_strings)} {f'[{value}]' if action.nargs == '?' else value}"


def read_results(folder: Path) -> dict[str, dict]:
    """{name: contents} of the files of results in a folder and in those of its kinds."""
    return {
        path.relative_to(folder).with_suffix("").as_posix(): json.loads(path.read_text("utf-8"))
        for path in sorted(folder.rglob("*.json"))
    }


def marked(root: Path) -> list[str]:
    """The names of the tables for which there is a marker."""
    texts = (path.read_text("utf-8") for path in documents(root))
    return [name for text in texts for _, name, _ in BLOCK.findall(text)]


def read_tables(folder: Path, own: Collection[str] = ()) -> dict[str, str]:
    """{name: Markdown} of all tables. folder: with the results. own: names of tables that have
    markers of their own, which `kinds` leaves out. Raises TableError.
    """
    results = read_results(folder)
    measured = readme(results.pop("readme")) if "readme" in results else {}
    measured |= {name: table(contents) for name, contents in results.items()}
    measured["kinds"] = kinds({name: measured[name] for name in measured.keys() - set(own)})
    return measured | {"settings": settings(), "commands": commands(), "api": api()}


def with_tables(text: str, tables: dict[str, str]) -> str:
    """The text with every table written anew. Raises TableError if a marker lacks its partner or
    names no table.
    """

    def written(block):
        begin, name, end = block.groups()
        if name not in tables:
            raise TableError(f"table {name}: there is no docs/results/{name}.json")
        return f"{begin}\n{tables[name]}\n\n{end}"

    blocks = BLOCK.findall(text)
    if len(MARKER.findall(text)) != 2 * len(blocks):
        raise TableError("a table lacks its first or last line, <!-- end table -->")
    return BLOCK.sub(written, text)


def documents(root: Path) -> list[Path]:
    """The Markdown files that may hold tables."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def main(root: Path = ROOT) -> int:
    """Rewrite the tables of all documents and print which files changed; returns the exit
    status.
    """
    path = root / "docs" / "results"
    try:
        tables = read_tables(path, marked(root))
        for path in documents(root):
            old = path.read_text("utf-8")
            new = with_tables(old, tables)
            if new != old:
                path.write_text(new, "utf-8")
                print(f"wrote {path.relative_to(root)}")
    except TableError as error:
        print(f"{path}: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
