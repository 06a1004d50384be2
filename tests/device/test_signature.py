"""The parser of kernels' signatures."""

import numpy as np
import pytest
from support.toy_kernels import SOURCE

from pp_cl.device.signature import parse_signatures


def test_parsed_signature():
    n, scale, x, k, y = parse_signatures(SOURCE, "toy.cl")["rows"]
    assert (n.name, n.space, n.dtype, n.shape) == ("n", "", np.uint32, None)
    assert (scale.name, scale.dtype) == ("scale", np.float32)
    assert (x.space, x.dtype, x.width, x.const, x.shape) == (
        "global",
        np.float32,
        4,
        True,
        ("N", "WIDTH"),
    )
    assert (k.space, k.dtype, k.width, k.shape) == ("constant", np.uint32, 1, ("3",))
    assert (y.const, y.shape) == (False, ("N", "1"))


def test_all_kernels_of_a_file_are_found():
    signatures = parse_signatures(SOURCE, "toy.cl")
    assert list(signatures) == ["rows", "copied", "behind", "formulas"]
    assert [p.space for p in signatures["copied"]] == ["global", "local", "global"]
    assert signatures["copied"][2].shape is None


@pytest.mark.parametrize(
    "head, names",
    [
        ("kernel void f() {", []),
        ("__kernel void f(\n    const int a)\n{", ["a"]),
        (
            (
                "kernel __attribute__((reqd_work_group_size(1, 1, 1))) void f(\n    const int a,\n "
                "   const uchar b) {"
            ),
            ["a", "b"],
        ),
        ("kernel void f(\n    global float *restrict x  // (N, (H-1)/2, ?) nested\n) {", ["x"]),
    ],
)
def test_heads_that_are_understood(head, names):
    assert [p.name for p in parse_signatures(head + "\n}\n", "f.cl")["f"]] == names


def test_nested_brackets_in_a_shape():
    (x,) = parse_signatures(
        "kernel void f(\n    global float *x)  // (N, (H-1)/2, ?) nested\n{}", "f.cl"
    )["f"]
    assert x.shape == ("N", "(H-1)/2", "?")


@pytest.mark.parametrize(
    "parameters, message",
    [
        ("    global float *x)  // no shape", "f.cl: f: buffer 'x' has no shape"),
        ("    global float *x, const uint n)  // (N)", "one parameter per line"),
        ("    image2d_t picture)  // (N)", "cannot read parameter"),
        ("    const size_t n)", "cannot read parameter"),
        ("    const unsigned int n)", "cannot read parameter"),
        ("    const float4 colour)", "neither a global"),
        ("    float *x)  // (N)", "neither a global"),
        ("    global float *x)  // (N**2)", r"f.cl: f: x: 'N\*\*2' is no formula"),
        ("    global float *x)  // (len(N))", r"'len\(N\)' is no formula"),
        ("    global float *x)  // (4, N + 1.5)", r"'N \+ 1.5' is no formula"),
        ("    global float *x)  // (4, N and C)", "'N and C' is no formula"),
        ("    global float *x)  // (rows of N)", "'rows of N' is no formula"),
    ],
)
def test_heads_that_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        parse_signatures(f"kernel void f(\n{parameters}\n{{}}", "f.cl")
