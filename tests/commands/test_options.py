"""Texts of options that commands share."""

import pytest

from pp_cl.commands.options import read_metrics, read_numbers, read_shape, read_tolerance
from pp_cl.errors import UserError


def test_numbers_are_read_ascending():
    assert read_numbers("--points", "1e3,10,10", int, least=1, most=10**6) == [10, 1000]
    with pytest.raises(UserError):
        read_numbers("--points", "", int, least=1, most=10**6)


def test_shape_is_a_side_and_three_widths():
    assert read_shape("64", "16,32,48") == (64, (16, 32, 48))
    for size, widths in (("30", "1,2,3"), ("-4", "1,2,3"), ("4", "1,2"), ("4", "1,2,x")):
        with pytest.raises(UserError, match="^--(size|widths) "):
            read_shape(size, widths)


def test_metrics_are_known_names():
    assert read_metrics("psnr, lpips") == ("psnr", "lpips")
    for text in ("", "beauty", "psnr,beauty"):
        with pytest.raises(UserError, match="^--metrics"):
            read_metrics(text)


def test_tolerance_is_a_share_or_absent():
    assert read_tolerance(None) is None and read_tolerance("1e-3") == 1e-3
    for text in ("x", "2", "nan"):
        with pytest.raises(UserError, match="^--tolerance"):
            read_tolerance(text)
