"""Rules of the OpenCL sources. Each check takes a source and returns what breaks the rule."""

import re

MOST_COLUMNS = 100


def helpers_without_static(source):
    """Every function that is no kernel is static, those in macros included: a plain inline one has
    no definition to link with where a compiler declines to inline it.
    """
    source = re.sub(r"//.*|[ ]*\\$", "", source, flags=re.M)
    heads = re.findall(r"^ *((?:\w+[\s*]+)+)(\w+)\s?\([^{};]*\)\s*\{", source, re.M)
    linked = {"static", "kernel", "ALWAYS_INLINE", "else"}
    return [f"{name} is not static" for words, name in heads if not linked & set(words.split())]


def silent_kernels(source):
    """The lines above a kernel say who a work-item is, what it reads and what it writes."""
    heads = re.finditer(r"^kernel\b[^(]*(?:\(\(.*?\)\))?[^(]*?(\w+)\(", source, re.M)
    above = {m[1]: source[: m.start()].splitlines()[-1:] for m in heads}
    return [f"{n}: no comment above it" for n, x in above.items() if not x or x[0][:2] != "//"]


def long_lines(source):
    """At most 100 columns."""
    lines = enumerate(source.splitlines(), 1)
    return [f"line {i}: {len(x)} columns" for i, x in lines if len(x) > MOST_COLUMNS]
