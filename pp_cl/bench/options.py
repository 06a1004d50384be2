"""Texts of options as numbers."""

from pp_cl.errors import UserError


def read_shape(size: str, widths: str) -> tuple[int, tuple[int, int, int]]:
    """The numbers of --size and --widths. Raises UserError for what the network cannot have."""
    if not size.isdecimal() or int(size) % 4 or int(size) == 0:
        raise UserError(f"--size {size}: the network takes multiples of 4")
    numbers = [int(n) for n in widths.split(",") if n.isdecimal()]
    if len(numbers) != 3 or widths.count(",") != 2 or min(numbers) < 1:
        raise UserError(f"--widths {widths}: write three numbers of channels, as 128,256,512")
    return int(size), tuple(numbers)
