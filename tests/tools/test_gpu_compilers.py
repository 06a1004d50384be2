"""tools/gpu/compilers.py: what compilers say is read right; what must not build does not."""

import struct

import pytest

from tools.gpu import compilers
from tools.gpu.builds import Build
from tools.gpu.compilers import (
    BuildError,
    Usage,
    cached_build,
    compile_build,
    elf_section,
    parse_ptxas,
    parse_remarks,
    parse_ze_info,
    version,
)
from tools.gpu.packages import CompilerMissing
from tools.gpu_check import TARGETS

PTXAS = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'one' for 'sm_90'
ptxas info    : Function properties for one
    112 bytes stack frame, 24 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 255 registers, used 1 barriers, 2048 bytes smem, 400 bytes cmem[0]
ptxas info    : Compile time = 98.916 ms
ptxas info    : Compiling entry function 'two' for 'sm_90'
ptxas info    : Function properties for two
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 18 registers, used 0 barriers
"""
REMARKS = """x.cl:98:1: remark: Function Name: one [-Rpass-analysis=kernel-resource-usage]
   98 | {
x.cl:98:1: remark:     SGPRs: 50 [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     VGPRs: 133 [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     ScratchSize [bytes/lane]: 44 [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     Dynamic Stack: False [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     Occupancy [waves/SIMD]: 10 [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     SGPRs Spill: 2 [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     VGPRs Spill: 5 [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     LDS Size [bytes/block]: 512 [-Rpass-analysis=kernel-resource-usage]
"""
ZE_INFO = """---
kernels:
  - name:            one
    execution_env:
      grf_count:       128
      simd_size:       8
      slm_size:        4096
    per_thread_memory_buffers:
      - type:            scratch
        usage:           spill_fill_space
        size:            8192
      - type:            global
        usage:           private_space
        size:            64
        is_simt_thread:  true
  - name:            two
    execution_env:
      grf_count:       256
      simd_size:       32
kernels_misc_info:
  - name:            one
    args_info:
      - index:           0
        name:            n
"""
SPILLED = "warning: kernel one  compiled SIMD8 allocated 128 regs and spilled around 157\n"

# A value computed by a function that has no definition to link with.
NO_STATIC = """__attribute__((noinline)) inline float f(float x) { return x * x; }
kernel void k(global float *x) { x[0] = f(x[0]); }
"""
MANY = """kernel void k(const int n, const float a, global float *x)
{
    float v[400];
    x += 400 * get_global_id(0);
    #pragma unroll
    for (int i = 0; i < 400; i++)
        v[i] = x[i];
    for (int t = 0; t < n; t++)
        #pragma unroll
        for (int i = 0; i < 400; i++)
            v[i] = fma(v[i], a, v[(i + 7) % 400]);
    #pragma unroll
    for (int i = 0; i < 400; i++)
        x[i] = v[i];
}
"""
FEW = "kernel void k(global float *x) { x[get_global_id(0)] *= FACTOR; }\n"


def sources(folder, text):
    """A folder of kernels with one file."""
    (folder / "x.cl").write_text(text)
    return folder


@pytest.fixture(params=TARGETS)
def target(request):
    """Each target whose compilers are here."""
    try:
        version(request.param)
    except CompilerMissing as error:
        pytest.skip(f"{error}; make gpu-check fetches what it can")
    return request.param


def elf(names, contents):
    """A 64-bit ELF file of sections and nothing else."""
    table = b"".join(name.encode() + b"\0" for name in names)
    sections = [*contents, table]
    starts = [64 + sum(map(len, sections[:i])) for i in range(len(sections) + 1)]
    heads = b"".join(
        struct.pack("<IIQQQQIIQQ", at, 0, 0, 0, starts[i], len(section), 0, 0, 0, 0)
        for i, section in enumerate(sections)
        for at in [table.index(names[i].encode() + b"\0")]
    )
    head = b"\x7fELF".ljust(40, b"\0") + struct.pack("<Q", starts[-1])
    head = head.ljust(58, b"\0") + struct.pack("<HHH", 64, len(sections), len(sections) - 1)
    return head + b"".join(sections) + heads


def test_ptxas():
    assert parse_ptxas(PTXAS) == {"one": Usage(255, 32, 112, 2048), "two": Usage(18, 0, 0, 0)}


def test_remarks():
    assert parse_remarks(REMARKS) == {"one": Usage(133, 7, 44, 512)}


def test_ze_info():
    assert parse_ze_info(ZE_INFO, SPILLED) == {
        "one": Usage(128, 157, 64, 4096, 8),
        "two": Usage(256, 0, 0, 0, 32),
    }


def test_elf_section():
    data = elf([".text", ".ze_info", ".names"], [b"code", b"words"])
    assert elf_section(data, ".ze_info") == b"words"
    assert elf_section(data, ".text") == b"code"
    with pytest.raises(BuildError, match="no section .other"):
        elf_section(data, ".other")
    with pytest.raises(BuildError):
        elf_section(b"MZ", ".ze_info")


def test_a_small_kernel(target, tmp_path):
    folder = sources(tmp_path, FEW)
    found = compile_build(target, Build("x", ("FACTOR=2.0f",)), folder, tmp_path)["k"]
    assert found.spill == found.private == found.local == 0
    assert 0 < found.registers <= (128 if target == "dg2" else 16)
    assert (found.simd == 32) == (target == "dg2")


@pytest.mark.parametrize("text", [FEW, "kernel void k(", "#include <none.h>\n"])
def test_what_does_not_compile(target, text, tmp_path):
    with pytest.raises(BuildError):
        compile_build(target, Build("x", ()), sources(tmp_path, text), tmp_path)


def test_a_helper_without_static_does_not_link(target, tmp_path):
    if target == "dg2":
        pytest.skip("Intel's compiler links it")
    with pytest.raises(BuildError, match=r"Unresolved extern function 'f'|undefined.*: f"):
        compile_build(target, Build("x", ()), sources(tmp_path, NO_STATIC), tmp_path)
    mended = NO_STATIC.replace("inline float", "static inline float")
    assert "k" in compile_build(target, Build("x", ()), sources(tmp_path, mended), tmp_path)


def test_a_spill_is_seen(target, tmp_path):
    found = compile_build(target, Build("x", ()), sources(tmp_path, MANY), tmp_path)["k"]
    assert found.spill > 0


def test_what_was_compiled_is_kept_until_something_changes(tmp_path, monkeypatch):
    asked = []

    def compiled(*given):
        asked.append(given)
        return {"k": Usage(len(asked), 0, 0, 0, 8)}

    monkeypatch.setattr(compilers, "compile_build", compiled)
    monkeypatch.setattr(compilers, "CACHE", tmp_path / "cache")
    folder, build = sources(tmp_path, FEW), Build("x", ("A=1",))
    first = cached_build("dg2", build, folder, "ocloc 1")
    assert first == cached_build("dg2", build, folder, "ocloc 1") == {"k": Usage(1, 0, 0, 0, 8)}
    others = [("sm_90", build, "ocloc 1"), ("dg2", Build("x", ()), "ocloc 1")]
    for target, other, version_ in [*others, ("dg2", build, "ocloc 2")]:
        assert cached_build(target, other, folder, version_) != first
    for name, text in (("x.cl", FEW + "\n"), ("y.h", "\n")):
        before = len(asked)
        (folder / name).write_text(text)
        cached_build("dg2", build, folder, "ocloc 1")
        assert len(asked) == before + 1
