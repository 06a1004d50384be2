"""pp_cl/device/form.py: which form a device takes, and how much a work-item handles in each."""

from types import SimpleNamespace

import pyopencl as cl
import pytest

from pp_cl.device.discover import open_device
from pp_cl.device.form import (
    channel_ranges,
    group_items,
    group_ranges,
    lanes,
    row_parts,
    takes_cpu_form,
)
from pp_cl.device.launch import Kernel
from pp_cl.errors import UserError
from pp_cl.selftest.run import CASES, run_cases

# of the kernels with two forms; `make test-gpu-form` runs all tests
IN_GPU_FORM = (
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
    "loss: perceptual",
    "metrics: distance of LPIPS",
    "adam: arrays",
    "rmsprop: degree 2",
    "training: smoothing",
    "scene: demo",
)


def test_a_cpu_takes_its_form_unless_told_otherwise(dev, monkeypatch):
    of_device = bool(dev.device.type & cl.device_type.CPU)
    for unset in (None, ""):
        monkeypatch.delenv("PP_FORM", raising=False)
        if unset is not None:
            monkeypatch.setenv("PP_FORM", unset)
        assert takes_cpu_form(dev.device) == of_device
    monkeypatch.setenv("PP_FORM", "gpu")
    assert not takes_cpu_form(dev.device)
    assert not open_device().is_cpu


def test_another_form_is_refused(dev, monkeypatch):
    monkeypatch.setenv("PP_FORM", "tpu")
    with pytest.raises(UserError, match="^PP_FORM=tpu: must be gpu, or unset$"):
        takes_cpu_form(dev.device)


def test_lanes(dev, monkeypatch):
    monkeypatch.setattr(dev, "is_cpu", True)
    assert (lanes(dev), row_parts(dev)) == (16, 1)
    # 40 channels: two vectors and a half; pixels in one group
    assert channel_ranges(dev, 30, 20, 40) == ((3, 20, 30), (1, 16, 4))
    monkeypatch.setattr(dev, "is_cpu", False)
    assert (lanes(dev), row_parts(dev)) == (1, 16)
    # the first dimension, in which neighbours run in step, is that of the channels
    assert channel_ranges(dev, 30, 20, 40) == ((40, 20, 30), (16, 4, 1))


@pytest.mark.parametrize(("largest", "items"), [(1024, 256), (256, 256), (100, 64), (1, 1)])
def test_groups(largest, items):
    """A power of two that the device runs; none on CPUs, which take their work-group."""
    of = SimpleNamespace(is_cpu=False, device=SimpleNamespace(max_work_group_size=largest))
    assert group_items(of) == items
    assert group_ranges(of, 7, 16) == (112, 64)
    of.is_cpu = True
    assert group_ranges(of, 7, 16) == (7, None)
    assert group_items(of) == 1


@pytest.mark.parametrize("name", ["device: scan", "loss: L1 and SSIM", "loss: mask"])
def test_groups_are_no_larger_than_a_kernel_allows(dev, monkeypatch, name):
    """Compilers allow fewer work-items of kernels that take many registers."""
    made = Kernel.__init__

    def limited(kernel, *args, **named):
        made(kernel, *args, **named)
        kernel.largest_group = 32

    monkeypatch.setattr(Kernel, "__init__", limited)
    monkeypatch.setattr(dev, "is_cpu", False)
    monkeypatch.setattr(dev, "_programs", {})
    case = next(case for case in CASES if case.name == name)
    assert [row.passed for row in run_cases(dev, [case])] == [True]


def test_the_cases_in_the_form_for_gpus_are_there():
    assert set(IN_GPU_FORM) <= {case.name for case in CASES}


@pytest.mark.parametrize(
    "name",
    [*IN_GPU_FORM[:5], *(pytest.param(name, marks=pytest.mark.slow) for name in IN_GPU_FORM[5:])],
)
def test_the_form_for_gpus_computes_the_same(dev, monkeypatch, name):
    monkeypatch.setattr(dev, "is_cpu", False)
    case = next(case for case in CASES if case.name == name)
    assert [row.passed for row in run_cases(dev, [case])] == [True]
