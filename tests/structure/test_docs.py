"""The documents: every file that they name exists, and the index names every document."""

import re
from pathlib import Path

import pytest

from pp_cl.config import Config, sections

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
PATH = re.compile(r"`((?:pp_cl|cl|tests|tools|docs)/[\w./]+)`")
PLACEHOLDER = re.compile(r"\bW/|\b(?:test_)?x\.")  # as in cl/W/x.cl
# History: the changelog and a measurement name them.
REMOVED = {"tools/paper_scale.py", "tools/active_tiles.py"}


def named_files(text: str, folder: Path) -> list[Path]:
    """The files that a document in `folder` links to, or names as a path from the root."""
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
    paths = {p for p in PATH.findall(text) if not PLACEHOLDER.search(p)} - REMOVED
    return [folder / link for link in links] + [ROOT / path for path in sorted(paths)]


def test_a_missing_file_is_found():
    text = "[a](b.md#c), [d](https://e.f/), `pp_cl/none.py`, `cl/W/x.cl`, `make x`, `pp_cl/cli.py`"
    missing = [path.name for path in named_files(text, ROOT) if not path.exists()]
    assert missing == ["b.md", "none.py"]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_named_files_exist(path):
    files = named_files(path.read_text("utf-8"), path.parent)
    assert not [str(file) for file in files if not file.exists()]


@pytest.mark.parametrize("page", ["glossary", "architecture"])
def test_files_below_pp_cl_exist(page):
    text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    wings = "|".join(p.name for p in (ROOT / "pp_cl").iterdir() if p.is_dir())
    names = re.findall(rf"`((?:(?:{wings})/)[\w/]+\.py)`", text)
    assert names
    assert not [name for name in names if not (ROOT / "pp_cl" / name).exists()]


def test_the_index_names_every_document():
    text = (ROOT / "docs" / "index.md").read_text("utf-8")
    linked = {path.resolve() for path in named_files(text, ROOT / "docs")}
    assert {path for path in DOCUMENTS if path.name != "index.md"} <= linked


@pytest.mark.parametrize(
    "path", [p for p in DOCUMENTS if p.stem != "CHANGELOG"], ids=lambda p: p.stem
)
def test_named_settings_exist(path):
    known = {name: vars(values) for name, values in sections(Config())}
    words = re.findall(rf"\b({'|'.join(known)})\.(\w+)\b(?!\.)", path.read_text("utf-8"))
    files = {"py", "cl", "md", "json", "h"}
    assert not [w for w in words if w[1] not in known[w[0]] and w[1] not in files]
