"""The rules of the OpenCL sources, and that each finds what breaks it."""

from pathlib import Path

import pytest
from support import kernel_rules as rules

FOLDER = Path(__file__).parents[2] / "cl"
SOURCES = {
    path.relative_to(FOLDER).as_posix(): path.read_text("utf-8")
    for path in sorted([*FOLDER.rglob("*.cl"), *FOLDER.rglob("*.h")])
}

PLANTED = [
    (rules.helpers_without_static, "inline float f(float x) {\n}", "f is not static"),
    (
        rules.helpers_without_static,
        "inline void\nf(global const float *x,  // (N)\n  int n) {\n}",
        "f is not static",
    ),
    (rules.helpers_without_static, "uint16 f(void)\n{\n}", "f is not static"),
    (
        rules.helpers_without_static,
        "#define MAKE(T, name) \\\n    inline T f(const T x) {  \\\n    }\n",
        "f is not static",
    ),
    (rules.silent_kernels, "kernel void f(\n    const int n)\n{\n}", "f: no comment above it"),
    (
        rules.silent_kernels,
        "// f\n\nkernel __attribute__((vec_type_hint(float16))) void f(\n    const int n)\n{\n}",
        "f: no comment above it",
    ),
    (rules.long_lines, "\n// " + "x" * 98, "line 11: 101 columns"),
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
    [
        rules.helpers_without_static,
        rules.silent_kernels,
        rules.long_lines,
    ],
    ids=lambda check: check.__name__,
)
def test_the_rule_holds_everywhere(check):
    found = {name: check(source) for name, source in SOURCES.items()}
    assert not {name: complaints for name, complaints in found.items() if complaints}


def test_headers_are_included():
    sources = "".join(SOURCES.values())
    headers = [name for name in SOURCES if name.endswith(".h")]
    assert not [name for name in headers if f'#include "{name}"' not in sources]
