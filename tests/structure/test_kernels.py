import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "cl"
SOURCES = {
    path.relative_to(FOLDER).as_posix(): path.read_text("utf-8")
    for path in sorted([*FOLDER.rglob("*.cl"), *FOLDER.rglob("*.h")])
}


def helpers_without_static(source):
    """Functions other than kernels that are not static, including those in macros. A plain inline
    function has no definition to link with if the compiler declines to inline it.
    """
    source = re.sub(r"//.*|[ ]*\\$", "", source, flags=re.M)
    heads = re.findall(r"^ *((?:\w+[\s*]+)+)(\w+)\s?\([^{};]*\)\s*\{", source, re.M)
    linked = {"static", "kernel", "ALWAYS_INLINE", "else"}
    return [f"{name} is not static" for words, name in heads if not linked & set(words.split())]


def silent_kernels(source):
    """Kernels without a comment above, which must say what a work-item is, reads and writes."""
    heads = re.finditer(r"^kernel\b[^(]*?(\w+)\(", source, re.M)
    above = {m[1]: source[: m.start()].splitlines()[-1:] for m in heads}
    return [f"{n}: no comment above it" for n, x in above.items() if not x or x[0][:2] != "//"]


PLANTED = [
    (
        helpers_without_static,
        "#define MAKE(T, name) \\\n    inline T f(const T x,  // (N)  \\\n  int n) {  \\\n    }\n",
        "f is not static",
    ),
    (
        silent_kernels,
        "// f\n\nkernel void f(\n    const int n)\n{\n}",
        "f: no comment above it",
    ),
]

GOOD = """static inline int g(int x) {
}

// One work-item: x.
kernel void h(
    const int n)
{
}
"""


@pytest.mark.parametrize(("check", "source", "expected"), PLANTED)
def test_a_planted_violation_is_found(check, source, expected):
    assert check(f"{GOOD}\n{source}\n") == [expected]
    assert check(GOOD) == []


@pytest.mark.parametrize(
    "check",
    [helpers_without_static, silent_kernels],
    ids=lambda check: check.__name__,
)
def test_the_rule_holds_everywhere(check):
    complaints_by_file = {name: check(source) for name, source in SOURCES.items()}
    assert not {name: complaints for name, complaints in complaints_by_file.items() if complaints}


def included(name):
    headers = set(re.findall(r'#include "(.*)"', SOURCES[name]))
    return headers.union(*map(included, headers))


def test_kernels_are_declared_by_the_macro_of_common_h():
    kernels = [name for name in SOURCES if name.endswith(".cl")]
    assert not [name for name in kernels if "common.h" not in included(name)]


def test_headers_are_included():
    sources = "".join(SOURCES.values())
    headers = [name for name in SOURCES if name.endswith(".h")]
    assert not [name for name in headers if f'#include "{name}"' not in sources]
