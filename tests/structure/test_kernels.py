"""The rules of the OpenCL sources."""

from pathlib import Path

import pytest
from support.kernel_rules import helpers_without_static

FOLDER = Path(__file__).parents[2] / "cl"
SOURCES = sorted([*FOLDER.rglob("*.cl"), *FOLDER.rglob("*.h")])


@pytest.mark.parametrize(
    "source",
    [
        "inline float f(const float x) {\n    return x;\n}",
        "inline void\nf(global const float *x,  // (N)\n  int n) {\n}",
        "uint16 f(void)\n{\n}",
        "#define MAKE(T, name) \\\n    inline T f(const T x) {  \\\n    }\n",
    ],
)
def test_a_helper_without_static_is_found(source):
    assert helpers_without_static("static inline int g(int x) {\n}\n" + source) == ["f"]


def test_helpers_are_static():
    found = {p.name: helpers_without_static(p.read_text("utf-8")) for p in SOURCES}
    assert not {name: helpers for name, helpers in found.items() if helpers}
