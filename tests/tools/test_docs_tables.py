import json
from pathlib import Path

import pytest

from pp_cl.commands import COMMANDS
from pp_cl.settings import Config, every_setting
from tools import docs_tables as TOOL
from tools import provenance

ROOT = Path(__file__).parents[2]
TABLES = TOOL.read_tables(ROOT / "docs" / "results", TOOL.marked(ROOT))

RESULTS = {
    "measured": "times",
    "machine": "a machine",
    "date": "2026-01-01",
    "commit": "abc",
    "decides": "0123",
    "columns": [{"head": "n", "cell": "{n:,} points"}, {"head": "error", "cell": "{error:.1e}"}],
    "rows": [{"n": 1000, "error": 2e-6}, {"n": 2, "error": 0.0}, {"n": 3}],
}
TABLE = """Times. *Commit abc, 2026-01-01, a machine.*

| n | error |
|---|---|
| 1,000 points | 2.0e-6 |
| 2 points | 0 |
| 3 points |  |"""


def test_a_table():
    assert TOOL.table(RESULTS) == TABLE


@pytest.mark.parametrize("name", ["cl/a.cl", "pp_cl/engine/raster/b.py", "pp_cl/run.py"])
def test_no_release_states_figures_of_older_code(tmp_path, capsys, name):
    """One of two results was measured before a deciding file of the code changed."""
    results, code = tmp_path / "docs" / "results", tmp_path / name
    results.mkdir(parents=True)
    code.parent.mkdir(parents=True)
    code.write_text("before")
    old = RESULTS | {"decides": provenance.digest(tmp_path)}
    code.write_text("after")
    new = RESULTS | {"decides": provenance.digest(tmp_path)}
    for other in (tmp_path / "README.md", code.with_suffix(".pyc")):
        other.write_text("decides nothing")
    for file, contents in {"old": old, "new": new}.items():
        (results / f"{file}.json").write_text(json.dumps(contents))
    assert provenance.main(tmp_path) == 1
    printed = capsys.readouterr().err
    assert "old.json: of commit abc" in printed and "new.json" not in printed
    (results / "old.json").unlink()
    assert provenance.main(tmp_path) == 0 and not capsys.readouterr().err


@pytest.mark.parametrize("path", TOOL.documents(ROOT), ids=lambda path: path.stem)
def test_documents_are_up_to_date(path):
    text = path.read_text("utf-8")
    assert TOOL.with_tables(text, TABLES) == text


def test_all_results_are_shown_once():
    """A result of several kinds has a marker for each, or one for all kinds together."""
    shown = TOOL.marked(ROOT)
    assert len(shown) == len(set(shown))
    assert {name for name in TABLES if "/" not in name} <= set(shown) <= set(TABLES)


def test_tables_of_kinds(tmp_path):
    for name in ("h200/stages", "h200/trainings", "avx2/trainings", "trainings"):
        file = tmp_path / f"{name}.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(RESULTS | {"measured": name}))
    h200 = ["### h200", "H200/trainings", "H200/stages"]
    for own, expected in (([], ["### avx2", "Avx2/trainings", *h200]), (["avx2/trainings"], h200)):
        lines = TOOL.read_tables(tmp_path, own)["kinds"].splitlines()
        starts = [line.partition(".")[0] for line in lines if line.startswith(("#", "A", "H"))]
        assert starts == expected


def test_settings_and_commands_are_complete():
    assert all(f"- `{key}`" in TABLES["settings"] for key, _, _ in every_setting(Config()))
    assert all(f"## pp-cl {name}\n" in TABLES["commands"] for name in COMMANDS)
    assert "`--seed N`" in TABLES["commands"]
