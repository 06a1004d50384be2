"""Write the tables of measurements in README.md and docs/ from docs/results/*.json.

    python tools/docs_tables.py            # or make docs

The table of docs/results/NAME.json stands between the lines `<!-- table: NAME -->` and
`<!-- end table -->` of a Markdown file. A file of results holds

    measured   what the numbers are; machine, command, version, commit: how they were obtained.
               estimated, in its place: what numbers are that nobody measured
    columns    [{"head": text, "cell": format}]: format is a str.format of the row's keys
    rows       [{key: value}]; a key that a row lacks is printed as nothing
    notes      sentences below the table, optional
"""

import json
import re
import string
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^(<!-- table: (\S+) -->\n).*?^(<!-- end table -->)$", re.DOTALL | re.MULTILINE)
MARKER = re.compile(r"^<!-- (?:end )?table", re.MULTILINE)


class TableError(Exception):
    """What is wrong with a marker or with a file of results."""


class _Missing:
    """The value of a key that a row lacks: nothing, in any format."""

    def __format__(self, spec):
        return ""


def cell(template: str, row: dict) -> str:
    """The template filled from the row; empty if the row has none of its keys."""
    keys = {name for _, name, _, _ in string.Formatter().parse(template) if name}
    if keys and not keys & row.keys():
        return ""
    text = template.format(**{key: row.get(key, _Missing()) for key in keys})
    text = re.sub(r"\b0\.?0*e[+]00", "0", text)  # 0.0e+00 -> 0
    return re.sub(r"e([+-])0+(\d)", r"e\1\2", text).strip()  # 1e-06 -> 1e-6


def table(results: dict) -> str:
    """Markdown of a file of results: what was measured (or estimated) and how, the table, the
    notes.
    """
    kind = "estimated" if "estimated" in results else "measured"
    origin = f"{kind.capitalize()} with version {results['version']}"
    origin += f" on {results['machine']}" if "machine" in results else ""
    origin += f": `{results['command']}`" if "command" in results else ""
    what = results[kind]
    heads = [column["head"] for column in results["columns"]]
    rows = [[cell(column["cell"], row) for column in results["columns"]] for row in results["rows"]]
    lines = [f"{what[0].upper()}{what[1:]}. {origin}.", ""]
    lines += ["| " + " | ".join(line) + " |" for line in (heads, ["---"] * len(heads), *rows)]
    for note in results.get("notes", ()):
        lines += ["", note]
    return "\n".join(lines)


def read_results(folder: Path) -> dict[str, dict]:
    """{name: contents} of the files of results in a folder."""
    return {
        path.stem: json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))
    }


def with_tables(text: str, results: dict[str, dict]) -> str:
    """The text with every table written anew. Raises TableError for a marker without partner, or
    that names no results.
    """

    def written(block):
        begin, name, end = block.groups()
        if name not in results:
            raise TableError(f"table {name}: there is no docs/results/{name}.json")
        return f"{begin}\n{table(results[name])}\n\n{end}"

    blocks = BLOCK.findall(text)
    if len(MARKER.findall(text)) != 2 * len(blocks):
        raise TableError("a table lacks its first or last line, <!-- end table -->")
    return BLOCK.sub(written, text)


def documents(root: Path) -> list[Path]:
    """The Markdown files that may hold tables."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def main(root: Path = ROOT) -> int:
    """Rewrite the tables of all documents, print the files that changed; returns the exit
    status.
    """
    results = read_results(root / "docs" / "results")
    for path in documents(root):
        old = path.read_text("utf-8")
        try:
            new = with_tables(old, results)
        except TableError as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 2
        if new != old:
            path.write_text(new, "utf-8")
            print(f"wrote {path.relative_to(root)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
