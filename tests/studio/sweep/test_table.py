import json

import pytest

from pp_studio.sweep.table import markdown, write_tables


def row(scene, seed, psnr=None, ssim=0.5, points=100, seconds=1.0, *, setting=None, error=None):
    """The row of a run, or of a failed run if psnr is None."""
    head = {"scene": scene, "settings": setting or {}, "seed": seed, "folder": f"{scene}/{seed}"}
    if psnr is None:
        return head | {"error": error or "broken"}
    measured = {"psnr": psnr, "ssim": ssim, "points": points, "device": "d", "seconds": seconds}
    return head | measured


ROWS = [
    row("a", 1, 20.0, 0.50, points=100, seconds=1.0),
    row("a", 2, 23.0, 0.75, points=103, seconds=2.0),
    row("b", 1, 31.0, 0.25, points=11, seconds=10.0),
    row("b", 2),
]


def test_the_table_as_text():
    lines = markdown(ROWS).splitlines()
    assert lines == [
        "| run  |   number |         PSNR |            SSIM |  points |   seconds |",
        "| ---- | -------: | -----------: | --------------: | ------: | --------: |",
        "| a    |        2 | 21.50 ± 2.12 | 0.6250 ± 0.1768 | 102 ± 2 | 1.5 ± 0.7 |",
        "| b    |   1 of 2 |        31.00 |          0.2500 |      11 |      10.0 |",
        "| mean | 2 scenes |        26.25 |          0.4375 |      56 |       5.8 |",
        "",
        "Failed:",
        "",
        "- b seed 2: broken",
    ]
    rows = [row("a|b", 1, 20.0, setting={"points.count": "5"})]
    assert "a\\|b points.count=5 |" in markdown(rows) and "Failed" not in markdown(rows)


def test_the_files(tmp_path):
    written = write_tables(tmp_path, ROWS)
    stored = json.loads((tmp_path / "sweep.json").read_text())
    assert stored == written
    assert stored["runs"] == ROWS
    a, b = stored["scenes"]
    spread = {"psnr": 3.0, "ssim": 0.25, "points": 3, "seconds": 1.0}
    means = {"psnr": 21.5, "ssim": 0.625, "points": 101.5, "seconds": 1.5}
    # the standard deviation of two values is their distance divided by the root of 2
    means["spread"] = pytest.approx({name: value / 2**0.5 for name, value in spread.items()})
    assert a == {"scene": "a", "settings": {}, "runs": 2, "failed": 0} | means
    assert (b["runs"], b["failed"], b["psnr"], b["spread"]) == (1, 1, 31.0, {})
    # scenes have equal weight, whatever their number of runs
    means = {"psnr": 26.25, "ssim": 0.4375, "points": 56.25, "seconds": 5.75}
    assert stored["mean"] == [{"settings": {}, "scenes": 2, "missing": 0} | means]
    assert (tmp_path / "sweep.md").read_text() == markdown(ROWS)
    assert {p.name for p in tmp_path.iterdir()} == {"sweep.json", "sweep.md"}
