"""Kernels called with named arguments, whose shapes are checked against the comments of their
signatures.
"""

import functools
import math
import operator
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from types import CodeType
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array

from pp_cl.engine.device.signature import Parameter, compile_formula
from pp_cl.errors import UserError

# Work-group sizes when the caller names none. They are fixed, and the global size is rounded up to
# them, because PoCL compiles a kernel again for every new work-group size; hence the tail guards.
DEFAULT_LOCAL = {1: (64,), 2: (16, 4), 3: (16, 4, 1)}

# How many shapes and sizes of launches a kernel remembers, to check and round them only once: more
# than a network's layers have. The numbers of visible points, new each step, would fill memory.
REMEMBERED = 64


class Slot(NamedTuple):
    """A parameter in the order of the kernel's. dtype: None for a scalar. least, largest: integers
    that a scalar may be. letter: the letter whose size a scalar gives, or None.
    """

    parameter: Parameter
    name: str
    dtype: np.dtype | None
    least: int
    largest: int
    letter: str | None


class Dimension(NamedTuple):
    """A dimension of a buffer. text: as its comment has it. letter: the text in lower case if it is
    a letter that no macro defines, otherwise "".
    """

    parameter: Parameter
    axis: int
    text: str
    letter: str
    formula: CodeType


class Kernel:
    """A compiled kernel that is called with named arguments."""

    def __init__(
        self,
        program: cl.Program,
        name: str,
        device: cl.Device,
        parameters: list[Parameter],
        *,
        defines: dict[str, Any],
        label: str,
    ):
        self._program, self._name = program, name
        self._types = [None if p.is_buffer else p.dtype for p in parameters]
        self._kernel = self._made()
        limit = cl.kernel_work_group_info.WORK_GROUP_SIZE
        self.largest_group: Any = self._kernel.get_work_group_info(limit, device)  # work-items
        self.most_items = tuple(device.max_work_item_sizes)  # work-items, by dimension
        self.parameters = parameters
        self.names = {p.name for p in parameters}
        self.label = label
        self.run = f"run {label}"  # for messages of Device.attempt()
        self._device_name = device.name.strip()
        words = {word for p in parameters for word in p.shape or () if word != "?"}
        names = {name for word in words for name in compile_formula(word).co_names}
        self._macros = {name: int(defines[name]) for name in names & defines.keys()}
        letters = {name.lower() for name in names}
        self._slots = [
            Slot(
                p,
                p.name,
                np.dtype(p.dtype) if p.is_buffer else None,
                *(p.limits or (1, 0)),
                p.name.lower() if not p.is_buffer and p.name.lower() in letters else None,
            )
            for p in parameters
        ]
        # letters first: the others are computed from them
        dimensions = [
            Dimension(
                p, axis, word, word.lower() if word in names - defines.keys() else "", formula
            )
            for p in parameters
            for axis, word in enumerate(p.shape or ())
            if word != "?" and (formula := compile_formula(word))
        ]
        self._dimensions = sorted(dimensions, key=lambda dimension: not dimension.letter)
        self._checked: set[Any] = set()  # shapes and sizes already found valid
        self._ranges: dict[Any, Any] = {}  # {(size, work-group) as given: as enqueued}

    def arguments(self, values: dict[str, Any]) -> list[Any]:
        """OpenCL arguments in order, from {name: pyopencl Array, None for NULL, or number}. Raises
        TypeError (names, dtypes) and ValueError (shapes).
        """
        if values.keys() != self.names:
            missing = [p.name for p in self.parameters if p.name not in values]
            unknown = [n for n in values if n not in self.names]
            raise TypeError(f"{self.label}: missing {missing}, unknown {unknown}")
        arguments: list[Any] = []
        shapes: list[Any] = []
        sizes: dict[str, int] = {}
        for p, name, dtype, least, largest, letter in self._slots:
            value = values[name]
            if dtype is not None:
                if value is None and p.may_be_null:
                    arguments.append(None)
                    shapes.append(None)
                    continue
                if not isinstance(value, cl_array.Array) or value.dtype != dtype:
                    raise TypeError(
                        f"{self.label}: {name} is {_kind(value)}, expected a device array of"
                        f" {dtype}"
                    )
                arguments.append(value.data if value.offset else value.base_data)
                shapes += value.shape, value.strides
            elif type(value) is int and least <= value <= largest:
                arguments.append(value)
                if letter:
                    sizes[letter] = value
            else:
                number = self._scalar(p, value)
                arguments.append(number)
                if letter:
                    sizes[letter] = int(number)
        key = *shapes, *sizes.values()
        if key not in self._checked:
            self._check_buffers(values, sizes)
            if len(self._checked) > REMEMBERED:
                self._checked.clear()
            self._checked.add(key)
        return arguments

    def _made(self):
        kernel = cl.Kernel(self._program, self._name)
        # given their types, pyopencl packs scalars itself; otherwise ten of them take it 40 us
        kernel.set_scalar_arg_dtypes(self._types)
        return kernel

    def with_arguments(self, values: list[Any], *, for_good: bool = False) -> cl.Kernel:
        """The kernel with values from arguments(): for one launch, or a new one that keeps them."""
        kernel = self._made() if for_good else self._kernel
        kernel.set_args(*values)
        return kernel

    def ranges(
        self, size: int | tuple[int, ...], local: int | tuple[int, ...] | None
    ) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
        """(work-items, work-group) to enqueue for launch()'s size and local; None if there are no
        work-items.

        Raises UserError when the work-group is too large for the device.
        """
        key = size, local
        if key not in self._ranges:
            if len(self._ranges) > REMEMBERED:
                self._ranges.clear()
            self._ranges[key] = self._rounded(size, local)
        return self._ranges[key]

    def _rounded(self, size, local):
        size = (int(size),) if np.isscalar(size) else tuple(int(s) for s in size)
        if local is None:
            local = self._default_group(len(size))
        else:
            local = (local,) if np.isscalar(local) else tuple(local)
        if 0 in size:
            return None
        if len(local) > 1:  # Apple's CPU driver allows only one-dimensional groups
            local = tuple(map(min, local, self.most_items))
        if math.prod(local) > self.largest_group:
            raise UserError(
                f"{self.label}: a work-group of {math.prod(local)} work-items, but"
                f" {self._device_name} runs at most {self.largest_group} of this kernel: choose"
                " another device (`pp-cl devices`)"
            )
        return tuple(-(-s // group) * group for s, group in zip(size, local, strict=True)), local

    def _default_group(self, dimensions):
        """The default work-group, halved until the device runs it: rusticl's software renderer runs
        at most 32 work-items of some kernels.
        """
        local = list(DEFAULT_LOCAL[dimensions])
        while math.prod(local) > max(1, self.largest_group):
            local[local.index(max(local))] //= 2
        return tuple(local)

    def _scalar(self, p, value):
        try:
            if p.limits is None:
                return float(value)
            number = int(operator.index(value))  # index() refuses the 2.5 that int() cuts to 2
            if not p.limits[0] <= number <= p.limits[1]:
                raise OverflowError("out of range")
            return number
        except (TypeError, OverflowError) as error:
            raise TypeError(
                f"{self.label}: {p.name} = {value!r} is no {np.dtype(p.dtype)}: {error}"
            ) from error

    def _check_buffers(self, values, sizes):
        """Compare the arrays with their parameters. sizes: {letter: size} given by scalars; this
        adds the sizes of the other letters.
        """
        for p, name, dtype, *_ in self._slots:
            array = values[name]
            if dtype is None or array is None:
                continue
            if not _is_contiguous(array.shape, array.strides, dtype.itemsize):
                raise ValueError(
                    f"{self.label}: {p.name} has shape {array.shape} and strides {array.strides}:"
                    " not contiguous"
                )
            if p.shape is not None and len(array.shape) != len(p.shape):
                raise ValueError(
                    f"{self.label}: {p.name} has shape {array.shape}, expected rank"
                    f" {len(p.shape)} {p.shape}"
                )
        for p, axis, word, letter, formula in self._dimensions:
            if values[p.name] is None:
                continue
            size = values[p.name].shape[axis]
            if letter:
                expected = sizes.setdefault(letter, size)
            else:
                known = {n: self._macros.get(n, sizes.get(n.lower())) for n in formula.co_names}
                if None in known.values():  # a letter that is never a dimension by itself
                    expected = sizes.setdefault(word, size)
                else:
                    expected = eval(formula, {}, known)  # noqa: S307 - of compile_formula()
            if size != expected:
                raise ValueError(
                    f"{self.label}: {p.name} has shape {values[p.name].shape}, expected {p.shape}"
                    f" with {word} = {expected}"
                )


@functools.lru_cache(1024)
def _is_contiguous(shape, strides, item_bytes):
    for size, stride in zip(reversed(shape), reversed(strides), strict=True):
        if size > 1 and stride != item_bytes:
            return False
        item_bytes *= size
    return True


def _kind(value):
    return (
        f"an array of {value.dtype}"
        if isinstance(value, cl_array.Array)
        else f"a {type(value).__name__}"
    )


def cut(
    size: tuple[int, ...], local: tuple[int, ...], parts: int, along: int
) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """(offset, work-items) of about `parts` launches that share `size` work-items, cut between the
    work-groups along one dimension.
    """
    step = -(-size[along] // (local[along] * parts)) * local[along]
    for first in range(0, size[along], step):
        offset, part = [0] * len(size), list(size)
        offset[along], part[along] = first, min(step, size[along] - first)
        yield tuple(offset), tuple(part)


@contextmanager
def quiet_compiler() -> Iterator[None]:
    """Silences the warning about compiler output, which Intel's compiler causes at every build.
    PYOPENCL_COMPILER_OUTPUT=1 shows the output.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Non-empty compiler output", cl.CompilerWarning)
        yield
