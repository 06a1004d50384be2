"""tools/docs_tables.py: the documents hold the tables that it writes."""

import json
import re
from pathlib import Path

import pytest

from pp_cl.cli import COMMANDS
from pp_cl.config import Config, sections
from tools import docs_tables as TOOL

ROOT = Path(__file__).parents[2]
TABLES = TOOL.read_tables(ROOT / "docs" / "results")

RESULTS = {
    "measured": "times",
    "machine": "a machine",
    "version": "1",
    "columns": [{"head": "n", "cell": "{n:,} {unit}"}, {"head": "error", "cell": "{error:.1e}"}],
    "rows": [{"n": 1000, "error": 2e-6}, {"n": 2, "unit": "points", "error": 0.0}, {"n": 3}],
    "notes": ["A note."],
}
TABLE = """Times. Measured with version 1 on a machine.

| n | error |
|---|---|
| 1,000 | 2.0e-6 |
| 2 points | 0 |
| 3 |  |

A note."""


def test_a_table():
    assert TOOL.table(RESULTS) == TABLE


@pytest.mark.parametrize("path", TOOL.documents(ROOT), ids=lambda path: path.stem)
def test_documents_are_up_to_date(path):
    text = path.read_text("utf-8")
    assert TOOL.with_tables(text, TABLES) == text


def test_all_results_are_shown_once_or_linked():
    text = "".join(path.read_text("utf-8") for path in TOOL.documents(ROOT))
    shown = re.findall(r"(?m)^<!-- table: (\S+) -->$", text)
    linked = set(re.findall(r"results/(\w+)\.json", text)) - set(shown)
    assert sorted([*shown, *linked]) == sorted(TABLES)


def test_settings_and_commands_are_complete():
    for section, values in sections(Config()):
        assert all(f"| `{section}.{name}` |" in TABLES["settings"] for name in vars(values))
    assert all(f"## pp-cl {name}\n" in TABLES["commands"] for name in COMMANDS)
    assert "- `--seed S`: " in TABLES["commands"]


def test_it_writes_what_changed_and_nothing_else(tmp_path, capsys):
    (tmp_path / "docs" / "results").mkdir(parents=True)
    (tmp_path / "docs" / "results" / "times.json").write_text(json.dumps(RESULTS))
    readme = tmp_path / "README.md"
    readme.write_text("before\n\n<!-- table: times -->\nold\n<!-- end table -->\nafter\n")
    (tmp_path / "docs" / "other.md").write_text("| a | b |\n")
    assert TOOL.main(tmp_path) == 0
    assert capsys.readouterr().out == "wrote README.md\n"
    assert readme.read_text() == (
        f"before\n\n<!-- table: times -->\n\n{TABLE}\n\n<!-- end table -->\nafter\n"
    )
    assert TOOL.main(tmp_path) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("<!-- table: nobody -->\n<!-- end table -->\n", "nobody.json"),
        ("<!-- table: times -->\n| a |\n", "lacks"),
        ("| a |\n<!-- end table -->\n", "lacks"),
    ],
)
def test_bad_markers(text, word, tmp_path, capsys):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text(text)
    assert TOOL.main(tmp_path) == 2
    assert word in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == text
