"""The signatures of kernels, parsed from their sources: types, and the shapes in their comments."""

import functools
import re
from dataclasses import dataclass
from functools import cached_property
from types import CodeType

import numpy as np

SCALARS = {
    "uchar": np.uint8,
    "ushort": np.uint16,
    "int": np.int32,
    "uint": np.uint32,
    "ulong": np.uint64,
    "half": np.float16,
    "float": np.float32,
}

_KERNEL = re.compile(r"^kernel\s+void\s+(\w+)\s*\(", re.MULTILINE)
_PARAMETER = re.compile(
    r"^(?:(global)\s+)?((?:(?:const|restrict|volatile)\s+)*)"
    r"([a-z]+?)(\d*)\s*(\*?)\s*(?:restrict\s+)?(\w+)$"
)
_SHAPE = re.compile(r"^\(([^()]*(?:\([^()]*\)[^()]*)*)\)")
_FORMULA = re.compile(r"\(*\w+\)*(?: ?[-+*/] ?\(*\w+\)*)*")


@dataclass(frozen=True)
class Parameter:
    """One kernel parameter. shape: the dimensions of its comment as text, such as "N+1"; None for
    a scalar or for `(...)`. may_be_infinite, may_be_null: its comment says "infinite", "NULL".
    """

    name: str
    is_buffer: bool  # a global pointer
    dtype: type
    width: int  # values in its OpenCL vector
    const: bool  # whether its data is const
    shape: tuple | None
    may_be_infinite: bool
    may_be_null: bool

    @cached_property
    def limits(self) -> tuple[int, int] | None:
        """The least and the largest integer of its type, None for a float."""
        if not issubclass(self.dtype, np.integer):
            return None
        return int(np.iinfo(self.dtype).min), int(np.iinfo(self.dtype).max)


def parse_signatures(source: str, file: str) -> dict[str, list[Parameter]]:
    """{kernel name: [Parameter, ...]} of an OpenCL C source that follows docs/conventions.md.

    Raises ValueError naming the file, kernel and line of a parameter that does not follow them.
    """
    signatures = {}
    for match in _KERNEL.finditer(source):
        parameters = []
        for line in source[match.end() :].split("\n"):
            code, _, comment = line.partition("//")
            code = code.strip()
            last = code.rstrip(" {").endswith(")")
            code = code.rstrip(" {").rstrip(")").rstrip(",").strip()
            if code:
                parameters.append(
                    _parse_parameter(code, comment.strip(), f"{file}: {match.group(1)}")
                )
            if last:
                break
        signatures[match.group(1)] = parameters
    return signatures


def _parse_parameter(code, comment, where):
    match = _PARAMETER.match(code)
    if not match or match.group(3) not in SCALARS:
        raise ValueError(f"{where}: cannot read parameter {code!r}; one parameter per line")
    space, qualifiers, base, width, star, name = match.groups()
    if bool(space) != bool(star) or (width and not star):
        raise ValueError(f"{where}: {code!r} is neither a global pointer nor a scalar")
    shape = None
    if star:
        words = _SHAPE.match(comment)
        if not words:
            raise ValueError(f"{where}: buffer {name!r} has no shape in its comment")
        shape = tuple(w.strip() for w in words.group(1).split(",") if w.strip())
        shape = None if shape == ("...",) else shape
        try:
            [compile_formula(word) for word in shape or () if word != "?"]
        except ValueError as error:
            raise ValueError(f"{where}: {name}: {error}") from None
    kind = SCALARS[base], int(width or 1), "const" in qualifiers
    return Parameter(name, bool(space), *kind, shape, "infinite" in comment, "NULL" in comment)


@functools.cache
def compile_formula(text: str) -> CodeType:
    """Compile a dimension in a buffer's comment, such as `N+1`, `c1 + c2` or `(H-1)/2`, for eval().
    co_names are the names in it; / divides whole numbers.

    Raises ValueError unless it is a formula of integers, names, brackets and + - * /.
    """
    try:
        if not _FORMULA.fullmatch(text):
            raise SyntaxError
        return compile(text.replace("/", "//"), text, "eval")
    except SyntaxError:
        raise ValueError(f"{text!r} is no formula of integers, names and + - * /") from None
