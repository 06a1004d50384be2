"""The rules of the Python sources, and that each finds what breaks it."""

import ast
from pathlib import Path

import pytest
from support import rules

ROOT = Path(__file__).parents[2]
TREES = {
    path.relative_to(ROOT).as_posix(): ast.parse(path.read_text("utf-8"))
    for path in sorted((ROOT / "pp_cl").rglob("*.py"))
}

PLANTED = [
    (
        rules.imports_from_above,
        "pp_cl/raster/x.py",
        "from pp_cl.train import step",
        "raster imports train",
    ),
    (
        rules.imports_from_above,
        "pp_cl/errors.py",
        "def f():\n    import pp_cl.config",
        "errors imports config",
    ),
    (rules.imports_from_above, "pp_cl/model.py", "from pp_cl import cli", "model imports cli"),
    (rules.prints, "pp_cl/raster/x.py", "print(1)", "print"),
    (rules.prints, "pp_cl/run.py", "import sys\nsys.stderr.write('')", "sys.stderr"),
    (rules.prints, "pp_cl/run.py", "tell = print", "print"),
    (rules.foreign_writes, "pp_cl/x.py", "def f(net):\n    net.variant = 1", "net.variant"),
    (
        rules.foreign_writes,
        "pp_cl/x.py",
        "class A:\n    def f(self):\n        self.a, self.cache.budget = 1, 2",
        "self.cache.budget",
    ),
    (rules.foreign_writes, "pp_cl/x.py", "def f(dev):\n    dev.bytes += 1", "dev.bytes"),
    (rules.untyped_functions, "pp_cl/x.py", "def f(a: int): pass", "f has no types"),
    (rules.untyped_functions, "pp_cl/x.py", "def f(a, *, b: int) -> int: pass", "f has no types"),
    (
        rules.untyped_functions,
        "pp_cl/x.py",
        "class A:\n    def __init__(self, a): pass",
        "__init__ has no types",
    ),
    (rules.lambdas_in_dicts, "pp_cl/x.py", "a = {1: lambda: 2}", "line 1: lambda in a dict"),
]

GOOD = """
from pp_cl.errors import UserError

class A:
    def __init__(self, a: int):
        self.a, self.b = a, a

    def f(self, a: int, *, b: int) -> None:
        raise UserError("print()")
"""


@pytest.mark.parametrize(("check", "path", "source", "expected"), PLANTED)
def test_a_planted_violation_is_found(check, path, source, expected):
    assert check(ast.parse(source), path) == [expected]
    assert check(ast.parse(GOOD), path) == []


@pytest.mark.parametrize(
    "check",
    [
        rules.imports_from_above,
        rules.prints,
        rules.foreign_writes,
        rules.lambdas_in_dicts,
        rules.untyped_functions,
    ],
    ids=lambda check: check.__name__,
)
def test_the_rule_holds_everywhere(check):
    found = {path: check(tree, path) for path, tree in TREES.items()}
    assert not {path: complaints for path, complaints in found.items() if complaints}


def test_every_wing_has_a_floor():
    assert {rules.wing_of(path) for path in TREES} <= rules.FLOOR.keys()


def test_no_module_imports_itself_through_others():
    planted = {
        "pp_cl/a.py": "from pp_cl.b import f",
        "pp_cl/b.py": "import pp_cl.c",
        "pp_cl/c.py": "from pp_cl import a",
    }
    chain = "pp_cl.a -> pp_cl.b -> pp_cl.c -> pp_cl.a"
    assert rules.circles({path: ast.parse(s) for path, s in planted.items()}) == [chain]
    assert rules.circles(TREES) == []
