import ast
import importlib
import re
from pathlib import Path

import pytest

from tools import docs_tables

ROOT = Path(__file__).parents[2]
# names with an underscore that may be used
OF_TUPLES, OTHERS = ("_replace", "_asdict", "_fields"), ("self", "cls", "os")


def faults(source, public):
    """Imports from pp_cl that are not public, and uses of names with an underscore."""
    violations = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            violations += [
                alias.name for alias in node.names if alias.name.partition(".")[0] == "pp_cl"
            ]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "pp_cl":
            names = {alias.name for alias in node.names}
            whole = {name for name in names if f"{node.module}.{name}" in public}  # whole modules
            violations += [
                f"{node.module}.{n}" for n in names - whole - public.get(node.module, set())
            ]
        elif isinstance(node, ast.Attribute) and node.attr[0] == "_" and node.attr[:2] != "__":
            owner = getattr(node.value, "id", None)
            if owner not in OTHERS and node.attr not in OF_TUPLES:
                violations.append(f".{node.attr}")
        elif isinstance(node, ast.Constant) and re.fullmatch(r"pp_cl(\.\w+)+", str(node.value)):
            violations.append(f"{node.value!r}")
    return violations


PUBLIC = {
    name: set(docs_tables.public_names(importlib.import_module(name)))
    for name in docs_tables.PUBLIC
}


@pytest.mark.parametrize(
    "source, fault",
    [
        ("from pp_cl.engine import lanes", "pp_cl.engine.lanes"),
        ("from pp_cl import config, run", "pp_cl.run"),
        ("import pp_cl.run", "pp_cl.run"),
        ("importlib.import_module('pp_cl.run')", "'pp_cl.run'"),
        ("self.run._compare(list)", "._compare"),
    ],
)
def test_what_is_internal_is_found(source, fault):
    assert faults(source, PUBLIC) == [fault]


def test_what_is_public_is_none():
    source = "from pp_cl import Run\nfrom pp_cl.commands import COMMANDS, options as shared\n"
    assert not faults(source + "self._seen = edits._replace(box=run.__class__)", PUBLIC)


def test_the_studio_uses_public_names_alone():
    sources = sorted((ROOT / "pp_studio").rglob("*.py"))
    violations = {str(path): faults(path.read_text("utf-8"), PUBLIC) for path in sources}
    assert violations and not {path: wrong for path, wrong in violations.items() if wrong}


@pytest.mark.parametrize("module", PUBLIC)
def test_what_is_listed_is_there(module):
    assert PUBLIC[module]
    assert all(hasattr(importlib.import_module(module), name) for name in PUBLIC[module])
