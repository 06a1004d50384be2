import numpy as np
import pytest

from pp_cl.bench import timing
from pp_cl.bench.plots import plot_time_and_error
from pp_cl.bench.timing import errors, interleave


def test_runs_take_turns(monkeypatch):
    monkeypatch.setattr(timing, "SECONDS", 0.0)
    calls = []
    times = interleave({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3)
    assert "".join(calls) == "ab" * 4  # one round more, which is not measured
    assert [len(t) for t in times.values()] == [3, 3]
    assert len(interleave({"a": lambda: None})["a"]) == timing.LEAST_ROUNDS


def test_errors_are_what_they_say_and_hide_no_nan():
    assert errors([3.0, 5.0], [3.0, 4.0]) == (0.2, 1.0)
    assert errors([0.0], [0.0]) == (0.0, 0.0)
    with pytest.raises(FloatingPointError):
        errors([np.nan], [1.0])


def network_row(variant, direction, ms, error):
    row = {"bench": "unet", "variant": variant, "direction": direction, "ms": ms}
    return row | {"rel_l2": error, "max_err": 1.0}


ROWS = [
    network_row("direct", "forward", 9.0, 1e-6),
    network_row("direct", "forward", 2.0, 0.0),
    network_row("winograd", "train", 3.0, 1e-5),
    {"bench": "raster", "blend": "alpha", "ms": 8.0, "max_err": 1e-7},
    {"bench": "train", "blend": "alpha", "ms": 8.0},  # lacks max_err
]


def test_time_against_error(tmp_path):
    file = tmp_path / "a.svg"
    (axes,) = plot_time_and_error(ROWS, str(file)).axes
    assert {line.get_label(): line.get_xydata().tolist() for line in axes.lines} == {
        "unet direct forward": [[9.0, 1e-6], [2.0, 1e-9]],
        "unet winograd train": [[3.0, 1e-5]],
        "raster alpha": [[8.0, 1e-7]],
    }
    assert len({line.get_color() for line in axes.lines}) == 3
    assert "<svg" in file.read_text()
