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
    "date": "2026-01-01",
    "commit": "abc",
    "version": "1",
    "columns": [{"head": "n", "cell": "{n:,} points"}, {"head": "error", "cell": "{error:.1e}"}],
    "rows": [{"n": 1000, "error": 2e-6}, {"n": 2, "error": 0.0}, {"n": 3}],
}
TABLE = """Times.

| n | error |
|---|---|
| 1,000 points | 2.0e-6 |
| 2 points | 0 |
| 3 points |  |"""


def test_a_table():
    assert TOOL.table(RESULTS) == TABLE


@pytest.mark.parametrize("path", TOOL.documents(ROOT), ids=lambda path: path.stem)
def test_documents_are_up_to_date(path):
    text = path.read_text("utf-8")
    assert TOOL.with_tables(text, TABLES) == text


def test_all_results_are_shown_once():
    text = "".join(path.read_text("utf-8") for path in TOOL.documents(ROOT))
    assert sorted(re.findall(r"(?m)^<!-- table: (\S+) -->$", text)) == sorted(TABLES)


def test_results_are_of_one_commit(tmp_path, capsys):
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    for commit in ("abc", "def"):
        (folder / f"{commit}.json").write_text(json.dumps(RESULTS | {"commit": commit}))
    assert TOOL.main(tmp_path) == 2
    assert "several commits" in capsys.readouterr().err


def test_the_output_in_the_readme_is_that_of_the_demo_in_its_table():
    row = TOOL.read_results(ROOT / "docs" / "results")["scenes"]["rows"][0]
    readme = " ".join((ROOT / "README.md").read_text("utf-8").split())
    assert "{psnr:.4f} {ssim:.4f} {lpips:.4f}".format(**row) in readme
    assert "trained {steps} steps in".format(**row) in readme
    assert "{points} points (".format(**row) in readme


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
