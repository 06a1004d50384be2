import json

import pytest

from tools import readme_lines as TOOL

STATED = json.loads(TOOL.FILE.read_text("utf-8"))
ROWS = {row["driver"]: row for row in STATED["rows"]}
DRIVERS = TOOL.drivers()


def test_the_commands_are_those_that_a_reader_types():
    train, evaluate = TOOL.commands()
    assert train.startswith("pp-cl train demo ") and evaluate == "pp-cl eval runs/demo --metrics"
    assert not {"--seed", "--network", "--set"} & {*train.split(), *evaluate.split()}


@pytest.mark.slow
@pytest.mark.parametrize("driver", ROWS)
def test_the_lines_are_what_the_commands_print(driver):
    """On the processor that README names all digits agree except for the seconds. Another one sums
    in another order, which changes a training slightly.
    """
    if driver not in DRIVERS:
        pytest.skip(f"{driver} is not installed")
    stated, measured = ROWS[driver], TOOL.row(driver, DRIVERS[driver])
    if (TOOL.machine(), measured["kind"]) == (STATED["machine"], stated["kind"]):
        names = ("steps", "points", "initial", "psnr", "ssim", "lpips")
        assert [measured[name] for name in names] == [stated[name] for name in names]
    assert float(measured["psnr"]) == pytest.approx(float(stated["psnr"]), abs=0.02)
    assert float(measured["points"]) == pytest.approx(float(stated["points"]), rel=0.005)
