"""Each case of `pp-cl selftest` is a test here; guarded buffers detect stray writes and reads of
undefined values.
"""

from pathlib import Path

import pytest

from pp_cl.engine.device.kernel import Kernel
from pp_cl.selftest.run import CASES, run_case

pytestmark = pytest.mark.kernels


def marks(case):
    """Cases that compare NaN are exact. All but those of layers and device take minutes in the
    simulator, which runs their kernels in other tests, too.
    """
    if case.name == "layers: tiles":
        return pytest.mark.exact
    return () if case.name.startswith(("layers", "device")) else pytest.mark.large


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name, marks=marks(c)) for c in CASES])
def test_passes(dev, case):
    row = run_case(dev, case)
    assert row.passed, row
    assert row.case == case.name and not row.reason and row.error <= row.bound
    if case.hard:  # the naive formula must fail a hard case
        assert row.hard.error <= row.hard.bound and not row.hard.naive <= row.hard.bound


def test_names_are_unique():
    assert len({case.name for case in CASES}) == len(CASES)


def test_the_page_of_hard_cases_lists_them():
    text = (Path(__file__).parents[2] / "docs" / "stability.md").read_text("utf-8")
    table = text.partition("<!-- table")[2].splitlines()
    head, *rows = (line for line in table if line.startswith("    "))
    first, second, third = (head.index(name) for name in ("hard case", "naive formula", "gives"))
    shown = [[row[first:second].strip(), row[second:third].strip()] for row in rows]
    assert shown == [[case.name, case.hard] for case in CASES if case.hard]
    assert len(shown) >= 30


# cases whose kernels work differently on GPUs; `make test-gpu-form` runs all tests in that form
GPU_CASES = (
    "device: scan",
    "device: compact and gather rows",
    "raster: project",
    "raster: thousands of equal depths",
    "raster: shade",
    "softmax: forward, soft",
    "softmax: backward, soft",
    "layers: mean pooling",
    "layers: upsampling",
    "layers: gate",
    "layers: tiles",
    "loss: L1 and SSIM",
    "loss: mask",
    "metrics: distance of LPIPS",
    "adam: arrays",
    "rmsprop: degree 2",
    "training: smoothing",
    "scene: demo",
)
BY_NAME = {case.name: case for case in CASES}


@pytest.mark.large
@pytest.mark.parametrize(
    "name",
    [*GPU_CASES[:5], *(pytest.param(name, marks=pytest.mark.slow) for name in GPU_CASES[5:])],
)
def test_as_on_gpus(dev, monkeypatch, name):
    monkeypatch.setattr(dev, "is_cpu", False)
    assert run_case(dev, BY_NAME[name]).passed


@pytest.mark.large
@pytest.mark.parametrize("name", ["device: scan", "loss: L1 and SSIM", "loss: mask"])
def test_groups_are_no_larger_than_a_kernel_allows(dev, monkeypatch, name):
    """Compilers allow fewer work-items for kernels that take many registers."""
    limit_groups(dev, monkeypatch, 32)
    assert run_case(dev, BY_NAME[name]).passed


@pytest.mark.large
def test_a_point_is_moved_by_one_group_or_not_at_all(dev, monkeypatch):
    """The kernel needs all 16 work-items of a point in one group, as they wait for each other."""
    limit_groups(dev, monkeypatch, 8)
    row = run_case(dev, BY_NAME["rmsprop: degree 2"])
    assert "rmsprop_move: a work-group of 16 work-items, but" in row.reason


def limit_groups(dev, monkeypatch, most):
    made = Kernel.__init__

    def limited(kernel, *args, **named):
        made(kernel, *args, **named)
        kernel.largest_group = most

    monkeypatch.setattr(Kernel, "__init__", limited)
    monkeypatch.setattr(dev, "is_cpu", False)
    monkeypatch.setattr(dev, "_programs", {})
