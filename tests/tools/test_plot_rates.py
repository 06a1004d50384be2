"""tools/plot_rates.py: the curves are the published schedule; the picture needs matplotlib."""

import sys

import numpy as np
import pytest

from pp_cl.config import assign, preset
from pp_cl.presets import PRESETS
from tools import plot_rates as TOOL

# of degrees 0, 1, 2, worked out by hand
PUBLISHED = {
    0: (0.5, 0.0025, 0.00125),
    250: (0.49428, 0.17548, 0.04805),
    500: (0.48862, 0.24431, 0.08673),
    1000: (0.4775, 0.23875, 0.11937),
    25_000: (0.15811, 0.07906, 0.03953),
    50_000: (0.05, 0.025, 0.0125),
}


def test_the_curves_of_the_paper_preset():
    rates = TOOL.sh_rates(preset("paper"), list(PUBLISHED))
    np.testing.assert_allclose(rates, list(PUBLISHED.values()), atol=6e-6)


def test_the_steps_that_are_drawn():
    whole, begin = TOOL.spans(preset("paper"))
    assert (whole[0], whole[-1], len(whole)) == (0, 50_000, TOOL.SAMPLES)
    assert (begin[0], begin[-1]) == (0, 2000)
    config = preset("paper")
    assign(config, "train.sh_delay", (0, 0, 0), "test")
    assign(config, "train.iterations", 10, "test")
    whole, begin = TOOL.spans(config)
    assert whole.tolist() == begin.tolist() == list(range(11))


@pytest.mark.parametrize("name", PRESETS)
def test_the_picture(tmp_path, capsys, name):
    pytest.importorskip("matplotlib", reason="the plot needs the extra `plot`")
    file = tmp_path / "rates.png"
    assert TOOL.main([str(file), "--preset", name]) == 0
    assert file.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out == f"wrote {file}\n"


def test_bad_input_is_one_line(tmp_path, capsys, monkeypatch):
    with pytest.raises(SystemExit):
        TOOL.main([str(tmp_path / "no" / "rates.png")])
    assert "OUT" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert TOOL.main([str(tmp_path / "rates.png")]) == 2
    told = capsys.readouterr().err
    assert "pp-cl[plot]" in told and told.count("\n") == 1
