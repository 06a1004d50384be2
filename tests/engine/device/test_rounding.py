"""Test the accuracy that OpenCL asks of divisions and square roots. The tests' tolerances rely on
it, as a GPU may have no better.
"""

import os

import numpy as np

from pp_cl.engine.device import device as device_module

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


def test_no_worse_than_opencl_allows(dev, rng, tmp_path, monkeypatch):
    (tmp_path / "rounding.cl").write_text(SOURCE)
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path)
    a, b = (np.exp(rng.normal(0, 5, (COUNT, 16))).astype(np.float32) for _ in range(2))
    quotient, root = dev.empty(a.shape), dev.empty(a.shape)
    dev.program("rounding").launch(
        "rounding", COUNT, n=COUNT, a=dev.upload(a), b=dev.upload(b), quotient=quotient, root=root
    )
    exact = a.astype(np.float64) / b, np.sqrt(a.astype(np.float64))
    division, root = (
        float((np.abs(computed.get() - value) / np.spacing(value.astype(np.float32))).max())
        for computed, value in zip((quotient, root), exact, strict=True)
    )
    assert division <= DIVISION_ULP and root <= ROOT_ULP
    if "-cl-fast-relaxed-math" in os.environ.get("PYOPENCL_BUILD_OPTIONS", ""):
        assert division > 1.5
