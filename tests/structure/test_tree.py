"""The rules of the tree."""

import ast
import configparser
import re
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from support.rules import identifiers, retired_words

ROOT = Path(__file__).parents[2]
KERNEL_FILES = sorted((ROOT / "cl").rglob("*.cl"))
SOURCES = sorted([*(ROOT / "pp_cl").rglob("*.py"), *KERNEL_FILES, *(ROOT / "cl").rglob("*.h")])
GLOSSARY = ROOT / "docs" / "glossary.md"


def test_every_kernel_file_is_launched_by_its_own_wing():
    """Its cases in the selftest: tests/selftest/test_perturbed.py."""
    orphans = []
    for path in KERNEL_FILES:
        name = path.relative_to(ROOT / "cl").with_suffix("").as_posix()
        modules = (ROOT / "pp_cl" / name).parent.glob("*.py")
        if not any(f'"{name}"' in module.read_text("utf-8") for module in modules):
            orphans.append(name)
    assert KERNEL_FILES
    assert not orphans


def test_setup_cfg_lists_every_package():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    folders = {path.parent for path in (ROOT / "pp_cl").rglob("*.py")}
    packages = {path.relative_to(ROOT).as_posix().replace("/", ".") for path in folders}
    assert set(setup["options"]["packages"].split()) == packages | {"pp_cl.cl"}


def test_setup_cfg_declares_every_package_that_is_imported():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    lists = setup["options"]["install_requires"], *setup["options.extras_require"].values()
    declared = {re.split("[<>=]", line)[0] for text in lists for line in text.split()}
    found, names = packages_distributions(), set()
    for path in (p for top in ("pp_cl", "tests", "tools") for p in (ROOT / top).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            if isinstance(node, ast.ImportFrom) and not node.level:
                names.add(node.module.partition(".")[0])
    names -= sys.stdlib_module_names | {"pp_cl", "tests", "tools", "oracle", "support"}
    packages = {name: found.get(name, [name])[0].lower().replace("_", "-") for name in names}
    assert "numpy" in names
    assert set(packages.values()) <= {name.lower() for name in declared}


PLANTED = """
# Glossary

| word | meaning |
|---|---|
| slot | memory |

## Retired words

| word | use instead |
|---|---|
| `wobble` | pixel jitter |
| early out | early stop |

## More

| a | b |
|---|---|
| c | d |
"""


def test_retired_words_are_found():
    words = retired_words(PLANTED)
    assert words == {"wobble": "pixel jitter", "early_out": "early stop"}
    python = '"""wobble"""\nx = "wobble"  # early_out\ndef wobble(): wobbles = 1 // early_out'
    assert identifiers(python, ".py") & words.keys() == {"wobble", "early_out"}
    assert not identifiers('"""wobble"""  # early_out', ".py") & words.keys()
    assert identifiers("// early_out\n#define wobble 1", ".cl") & words.keys() == {"wobble"}


def test_no_identifier_is_a_retired_word():
    if not GLOSSARY.is_file():
        pytest.skip("no docs/glossary.md")
    words = retired_words(GLOSSARY.read_text("utf-8"))
    found = {p: identifiers(p.read_text("utf-8"), p.suffix) & words.keys() for p in SOURCES}
    assert words
    assert not {str(p.relative_to(ROOT)): [(w, words[w]) for w in f] for p, f in found.items() if f}
