"""What OpenCL asks of divisions and square roots, on which the tests' tolerances count: a GPU may
round them no better.
"""

import os

import numpy as np
import pytest

from pp_cl.device import device as device_module

DIVISION_ULP, ROOT_ULP = 2.5, 3.0
COUNT = 1 << 16
SOURCE = """// One work-item: 16 quotients and 16 roots.
kernel void rounding(
    const uint n,             // vectors
    global const float16 *a,  // (N, 16)
    global const float16 *b,  // (N, 16)
    global float16 *quotient, // (N, 16)
    global float16 *root)     // (N, 16)
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    quotient[i] = a[i] / b[i];
    root[i] = sqrt(a[i]);
}
"""


@pytest.fixture
def errors(dev, rng, tmp_path, monkeypatch):
    """(of quotients, of roots): largest errors in units in the last place."""
    (tmp_path / "rounding.cl").write_text(SOURCE)
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path)
    a, b = (np.exp(rng.normal(0, 5, (COUNT, 16))).astype(np.float32) for _ in range(2))
    quotient, root = dev.empty(a.shape), dev.empty(a.shape)
    dev.program("rounding").launch(
        "rounding", COUNT, n=COUNT, a=dev.upload(a), b=dev.upload(b), quotient=quotient, root=root
    )
    exact = a.astype(np.float64) / b, np.sqrt(a.astype(np.float64))
    return [
        float((np.abs(found.get() - value) / np.spacing(value.astype(np.float32))).max())
        for found, value in zip((quotient, root), exact, strict=True)
    ]


def test_no_worse_than_opencl_allows(errors):
    division, root = errors
    assert division <= DIVISION_ULP
    assert root <= ROOT_ULP


@pytest.mark.skipif(
    "-cl-fast-relaxed-math" not in os.environ.get("PYOPENCL_BUILD_OPTIONS", ""),
    reason="for make test-coarse",
)
def test_the_coarse_division_is_coarse(errors):
    assert errors[0] > 1.5
