"""What the source tree promises: wings and floors, the rule of three by path."""

import re
from pathlib import Path

import pytest

from pp_cl.device.launch import parse_signatures

ROOT = Path(__file__).parents[1]
KERNEL_FILES = sorted((ROOT / "cl").rglob("*.cl"))
HEADERS = sorted((ROOT / "cl").rglob("*.h"))
MODULES = sorted(p for p in (ROOT / "pp_cl").rglob("*.py"))
TOOLS = sorted((ROOT / "tools").glob("*.py"))


def lines(path):
    """The lines of a source file."""
    return path.read_text("utf-8").splitlines()


def test_rule_of_three():
    missing = []
    for path in KERNEL_FILES:
        stem = path.relative_to(ROOT / "cl").with_suffix("")
        for other in (f"pp_cl/{stem}.py", f"tests/{stem.parent}/test_{stem.name}.py"):
            missing += [] if (ROOT / other).is_file() else [f"{path}: no {other}"]
    assert not missing


def test_oclgrind_checks_every_kernel_file():
    checked = re.search(r"^OCLGRIND := ((?:.*\\\n)*.*)$", (ROOT / "Makefile").read_text(), re.M)[1]
    stems = [p.relative_to(ROOT / "cl").with_suffix("") for p in KERNEL_FILES]
    tests = {f"tests/{s.parent}/test_{s.name}.py" for s in stems}
    assert not tests - set(checked.split())


def test_headers_are_included():
    sources = "".join(p.read_text("utf-8") for p in KERNEL_FILES + HEADERS)
    names = [p.relative_to(ROOT / "cl").as_posix() for p in HEADERS]
    assert not [name for name in names if f'#include "{name}"' not in sources]


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda p: p.stem)
def test_kernels_say_what_they_do_and_take_few_arguments(path):
    signatures = parse_signatures(path.read_text("utf-8"), path.name)
    assert signatures
    source = lines(path)
    for name, parameters in signatures.items():
        assert len(parameters) <= 12, f"{name} has {len(parameters)} parameters"
        at = next(i for i, x in enumerate(source) if re.match(rf"(__)?kernel\b.*\b{name}\s*\(", x))
        assert source[at - 1].startswith("//"), f"{name} has no comment above it"
