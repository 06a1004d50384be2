"""What the source tree promises: the rule of three, short files, kernels that say what they do, nothing dangerous."""

import re
from pathlib import Path

import pytest

from pp_cl.launch import parse_signatures

ROOT = Path(__file__).parents[1]
KERNEL_FILES = sorted((ROOT / "cl").glob("*.cl"))
HEADERS = sorted((ROOT / "cl").glob("*.h"))
MODULES = sorted((ROOT / "pp_cl").glob("*.py"))
TOOLS = sorted((ROOT / "tools").glob("*.py"))
SLACK = 1.1  # a limit is a direction, not a cliff
ENTRY_POINTS = {"__init__", "__main__", "cli"}

# Text from outside must never run: no code from strings, no pickles.
FORBIDDEN = re.compile(r"(?<![\w.])(eval|exec)\s*\(|\bpickle\.loads?\s*\(|allow_pickle\s*=\s*True|shell\s*=\s*True")


def by_stem(paths):
    """parametrize() arguments: one test a file, named after it."""
    return {"argvalues": paths, "ids": [p.stem for p in paths]}


def lines(path):
    """The lines of a source file."""
    return path.read_text("utf-8").splitlines()


def test_there_are_kernels_and_modules():
    assert len(KERNEL_FILES) >= 3
    assert len(MODULES) >= 10


@pytest.mark.parametrize("path", **by_stem(KERNEL_FILES))
def test_rule_of_three(path):
    assert (ROOT / "pp_cl" / f"{path.stem}.py").is_file(), "no module of the same stem launches it"
    assert (ROOT / "tests" / f"test_{path.stem}.py").is_file(), "no test of the same stem"


def test_oclgrind_checks_every_kernel_file():
    checked = re.search(r"^OCLGRIND := ((?:.*\\\n)*.*)$", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)[1].split()
    assert {p.stem for p in KERNEL_FILES} <= set(checked)


@pytest.mark.parametrize("path", **by_stem(HEADERS))
def test_headers_are_included(path):
    assert any(f'#include "{path.name}"' in p.read_text("utf-8") for p in KERNEL_FILES + HEADERS), "nobody includes it"


@pytest.mark.parametrize("path", **by_stem([p for p in MODULES if p.stem not in ENTRY_POINTS]))
def test_modules_are_imported(path):
    imported = re.compile(rf"^\s*(from pp_cl\.{path.stem} import|from pp_cl import .*\b{path.stem}\b)", re.MULTILINE)
    others = [p for p in MODULES + TOOLS if p != path]
    assert any(imported.search(p.read_text("utf-8")) for p in others), "no module and no tool imports it"


def test_oracles_stay_in_the_tests():
    imported = re.compile(r"^\s*(from|import) (tests|oracle|helpers)", re.MULTILINE)
    assert not [p.name for p in MODULES if imported.search(p.read_text("utf-8"))]


@pytest.mark.parametrize("path", **by_stem(KERNEL_FILES))
def test_kernel_files_are_short(path):
    assert len(lines(path)) <= 250 * SLACK


@pytest.mark.parametrize("path", **by_stem(MODULES))
def test_modules_are_short(path):
    assert len(lines(path)) <= 300 * SLACK


@pytest.mark.parametrize("path", **by_stem(KERNEL_FILES))
def test_kernels_say_what_they_do_and_take_few_arguments(path):
    signatures = parse_signatures(path.read_text("utf-8"), path.name)
    assert signatures
    source = lines(path)
    for name, parameters in signatures.items():
        assert len(parameters) <= 12, f"{name} has {len(parameters)} parameters"
        at = next(i for i, line in enumerate(source) if re.match(rf"(__)?kernel\b.*\b{name}\s*\(", line))
        assert source[at - 1].startswith("//"), f"{name} has no comment above it"


@pytest.mark.parametrize("path", **by_stem(KERNEL_FILES + HEADERS))
def test_kernel_lines_are_short(path):
    assert not [f"{path.name}:{i}" for i, line in enumerate(lines(path), 1) if len(line) > 125]


@pytest.mark.parametrize("path", **by_stem(MODULES + TOOLS))
def test_nothing_dangerous(path):
    found = FORBIDDEN.search(path.read_text("utf-8"))
    assert not found, f"{found.group()!r}"


@pytest.mark.parametrize("bad", ["x = eval(text)", "exec (text)", "pickle.load(f)", "np.load(f, allow_pickle=True)"])
def test_the_search_for_danger_finds_it(bad):
    assert FORBIDDEN.search(bad)


@pytest.mark.parametrize("good", ["model.eval()", "self.eval(x)", "np.load(f, allow_pickle=False)", "retrieval(x)"])
def test_the_search_for_danger_spares_the_rest(good):
    assert not FORBIDDEN.search(good)


@pytest.mark.parametrize("path", **by_stem(MODULES))
def test_modules_open_with_a_docstring(path):
    assert lines(path)[0].startswith('"""'), "no docstring in the first line"
