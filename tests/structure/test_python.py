"""Test the rules of the Python sources that no linter knows, and the contracts of import-linter
(setup.cfg).
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def untyped_functions(source):
    """Parameters of public functions and methods without a type. ruff checks the types of results,
    but does not know which functions are public.
    """
    tree = ast.parse(source)
    owners = [n for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name[0] != "_"]
    functions = [n for owner in [tree, *owners] for n in owner.body if isinstance(n, FUNCTIONS)]
    complaints = []
    for node in (n for n in functions if n.name[0] != "_" or n.name == "__init__"):
        parameters = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
        untyped = [a.arg for a in parameters if not a.annotation and a.arg not in ("self", "cls")]
        complaints += [f"{node.name}: {name} has no type" for name in untyped]
    return complaints


def test_public_functions_have_types():
    assert untyped_functions("class A:\n    def f(self, a, *, b: int): pass") == [
        "f: a has no type"
    ]
    complaints = {
        path: untyped_functions(path.read_text("utf-8")) for path in ROOT.glob("pp_*/**/*.py")
    }
    assert not {str(path): lines for path, lines in complaints.items() if lines} and complaints


def test_imports_go_down(monkeypatch):
    linter = pytest.importorskip("importlinter.cli")
    monkeypatch.chdir(ROOT)
    assert linter.lint_imports(no_cache=True, no_logo=True) == 0
