"""How the spherical harmonics of the points are stored: which coefficients lie in which array."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ShBlock:
    """The SH coefficients of one array (N, count, 16): `count` of one degree, those of the basis
    functions `first`, `first` + 1, ...

    name: sh_ and the degree, then a or b where a degree fills two arrays.
    """

    name: str
    first: int
    count: int

    @property
    def degree(self) -> int:
        """0, 1 or 2."""
        return math.isqrt(self.first)


# Degree 2 fills two arrays: no array takes more than 192 bytes a point, so that 4.04 million
# points fit devices that allocate at most 1 GiB at once. The layout is the same everywhere, and so
# are the bits.
SH_BLOCKS = (
    ShBlock("sh_0", 0, 1),
    ShBlock("sh_1", 1, 3),
    ShBlock("sh_2a", 4, 3),
    ShBlock("sh_2b", 7, 2),
)
SH_DEGREES = (0, 1, 2)


def sh_blocks(degree: int) -> tuple[ShBlock, ...]:
    """Those of SH_BLOCKS up to a degree."""
    return tuple(block for block in SH_BLOCKS if block.degree <= degree)


def stored_degree(blocks: int) -> int:
    """The degree of the first so many SH_BLOCKS. Raises ValueError where they end within one."""
    last, *following = SH_BLOCKS[blocks - 1 : blocks + 1]
    if following and following[0].degree == last.degree:
        raise ValueError(f"{blocks} arrays of coefficients end within degree {last.degree}")
    return last.degree


def sh_arguments(sh: Sequence[Any]) -> dict[str, Any]:
    """{name of a kernel's argument: array} of the first so many SH_BLOCKS; the first array stands
    for those that are absent, which a kernel of their degree leaves alone.
    """
    absent = [sh[0]] * (len(SH_BLOCKS) - len(sh))
    return {block.name: a for block, a in zip(SH_BLOCKS, [*sh, *absent], strict=True)}
