"""Rules of the OpenCL sources. Each function takes a source and returns what breaks its rule."""

import re


def helpers_without_static(source):
    """Names of the functions that are neither kernels nor static, those in macros included."""
    source = re.sub(r"//.*|[ ]*\\$", "", source, flags=re.M)
    heads = re.findall(r"^ *((?:\w+[\s*]+)+)(\w+)\s?\([^{};]*\)\s*\{", source, re.M)
    linked = {"static", "kernel", "ALWAYS_INLINE", "else"}
    return [name for words, name in heads if not linked & set(words.split())]
