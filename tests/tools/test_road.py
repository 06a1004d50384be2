import pytest

from tools import road


def test_the_page_is_what_a_step_calls(plain):
    """After a change of the step, run `make docs`."""
    if not plain.is_cpu:
        pytest.skip("the page is of CPUs")
    assert road.page(road.traced(plain)) == road.FILE.read_text("utf-8")


def test_lines_of_code_are_counted(tmp_path):
    (tmp_path / "a.py").write_text(
        'def f(a):\n    """Doc.\n\n    More.\n    """\n\n    # why\n    return a\n'
    )
    assert road.python_lines(tmp_path / "a.py") == {"f": 2}
    (tmp_path / "a.cl").write_text("// what\n\nint x;  // of it\n")
    assert road.kernel_lines(tmp_path / "a.cl") == 1
