import pytest

from tools import road


def test_the_page_is_what_a_step_calls(plain):
    """After a change of the step, run `make docs`."""
    if not plain.is_cpu:
        pytest.skip("the page is of CPUs")
    assert road.page(road.traced(plain)) == road.FILE.read_text("utf-8")


@pytest.mark.parametrize(
    ("macros", "built", "others"),
    [
        ({}, {"soft.h", "round.h"}, {"disc.h", "gaussian.h"}),
        ({"FOOTPRINT": "GAUSSIAN"}, {"gaussian.h"}, {"soft.h", "round.h"}),
        ({"LANES": 1}, {"vector.h"}, set()),
    ],
)
def test_headers_are_listed_if_a_kernel_is_built_with_them(macros, built, others):
    path = road.kernel_folder() / "raster" / "weights.cl"
    files = road.kernel_files(path, {"GROUP": 1} | macros)
    names = {file.name for file in files}
    assert built <= names and not others & names
    assert (road.kernel_folder() / "gpu" / "lanes.h" in files) == ("LANES" in macros)
    assert files[-1] == path and len(files) == len(set(files))


def test_lines_of_code_are_counted(tmp_path):
    (tmp_path / "a.py").write_text(
        'def f(a):\n    """Doc.\n\n    More.\n    """\n\n    # why\n    return a\n'
    )
    assert road.python_lines(tmp_path / "a.py") == {"f": 2}
    (tmp_path / "a.cl").write_text("// what\n\nint x;  // of it\n")
    assert road.kernel_lines(tmp_path / "a.cl") == 1
