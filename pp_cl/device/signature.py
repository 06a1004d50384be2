"""The signatures of kernels, parsed from their source: names, types, and the shapes of buffers.

Parsing works on drivers that give no argument info, too; the tests compare it with the driver's own
(-cl-kernel-arg-info).
"""

import functools
import re
from dataclasses import dataclass
from functools import cached_property
from types import CodeType

import numpy as np

SCALARS = {
    "char": np.int8,
    "uchar": np.uint8,
    "short": np.int16,
    "ushort": np.uint16,
    "int": np.int32,
    "uint": np.uint32,
    "long": np.int64,
    "ulong": np.uint64,
    "half": np.float16,
    "float": np.float32,
    "double": np.float64,
}

_KERNEL = re.compile(
    r"^(?:__)?kernel\s+(?:__attribute__\s*\(\(.*?\)\)\s*)?void\s+(\w+)\s*\(", re.MULTILINE
)
_PARAMETER = re.compile(
    r"^(?:(global|constant|local)\s+)?((?:(?:const|restrict|volatile)\s+)*)"
    r"([a-z]+?)(\d*)\s*(\*?)\s*(?:restrict\s+)?(\w+)$"
)
_SHAPE = re.compile(r"^\(([^()]*(?:\([^()]*\)[^()]*)*)\)")
_FORMULA = re.compile(r"\(*\w+\)*(?: ?[-+*/] ?\(*\w+\)*)*")


@dataclass(frozen=True)
class Parameter:
    """One kernel parameter. shape: the dimensions of its comment as text, such as "N+1"; None for
    a scalar or for `(...)`.
    """

    name: str
    space: str  # "global", "constant", "local", or "" for a scalar
    dtype: type
    width: int  # of the OpenCL vector
    const: bool  # what it points at
    shape: tuple | None

    @cached_property
    def limits(self) -> tuple[int, int] | None:
        """The least and the largest integer of its type, None for a float."""
        if not issubclass(self.dtype, np.integer):
            return None
        return int(np.iinfo(self.dtype).min), int(np.iinfo(self.dtype).max)


def parse_signatures(source: str, file: str) -> dict[str, list[Parameter]]:
    """{kernel name: [Parameter, ...]} of an OpenCL C source that follows docs/conventions.md.

    Raises ValueError naming the file, kernel and line of a parameter that does not.
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
    found = _PARAMETER.match(code)
    if not found or found.group(3) not in SCALARS:
        raise ValueError(f"{where}: cannot read parameter {code!r}; one parameter per line")
    space, qualifiers, base, width, star, name = found.groups()
    if bool(space) != bool(star) or (width and not star):
        raise ValueError(
            f"{where}: {code!r} is neither a global, constant or local pointer nor a scalar"
        )
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
    return Parameter(
        name, space or "", SCALARS[base], int(width or 1), "const" in qualifiers, shape
    )


@functools.cache
def compile_formula(text: str) -> CodeType:
    """A dimension in a buffer's comment, such as `N+1`, `c1 + c2` or `(H-1)/2`, for eval().
    co_names are the names in it; the division is one of whole numbers.

    Raises ValueError for what is no formula of integers, names, brackets and + - * /.
    """
    try:
        if not _FORMULA.fullmatch(text):
            raise SyntaxError
        return compile(text.replace("/", "//"), text, "eval")
    except SyntaxError:
        raise ValueError(f"{text!r} is no formula of integers, names and + - * /") from None
