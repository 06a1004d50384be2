"""tools/gpu/mix.py: inner loops are found and counted right; those of the convolutions for GPUs
multiply.
"""

import pytest

from tools.gpu.builds import read_builds
from tools.gpu.mix import LOOPS, TARGETS, Mix, inner_loops, main, mixes
from tools.gpu.packages import CompilerMissing

SASS = """
one:
        /*0000*/                   MOV R1, RZ ;
.L_x_1:
        /*0010*/                   IADD3 R1, R1, 0x1, RZ ;
.L_x_2:
        /*0020*/                   LDS.128 R4, [R1] ;
        /*0030*/                   FFMA R2, R4, R5, R2 ;
        /*0040*/              @!P0 FFMA.FTZ R3, R4, R5, R3 ;
        /*0050*/                   ISETP.NE.AND P0, PT, R1, 0x4, PT ;
        /*0060*/               @P0 BRA `(.L_x_2) ;
        /*0070*/               @P1 BRA `(.L_x_1) ;
        /*0080*/                   EXIT ;
"""
GCN = """
one:
	s_mov_b32 s1, 0
.LBB0_1:
	ds_load_b128 v[0:3], v9
	s_waitcnt lgkmcnt(0)
	v_dual_fmac_f32 v4, v0, v1 :: v_dual_mov_b32 v5, v2
	v_fma_f32 v6, v0, v2, v6
	s_add_i32 s1, s1, 1
	s_cbranch_scc1 .LBB0_1
	s_endpgm
two:
	v_mov_b32 v0, 0
"""


@pytest.mark.parametrize(
    ("text", "expected"), [(SASS, Mix(2, 1, 1, 1)), (GCN, Mix(2, 2, 1, 2))], ids=["sass", "gcn"]
)
def test_the_inner_loop_is_counted(text, expected):
    assert inner_loops(text) == {"one": expected}
    assert expected.share == expected.multiply_adds / (2 + expected.other_arithmetic)


@pytest.mark.parametrize("target", TARGETS)
def test_of_their_arithmetic_nineteen_in_twenty_multiply_and_add(target):
    widest = [build for build in read_builds() if "QUADS=16" in build.macros]
    builds = [build for build in widest if build.file in LOOPS]  # the loops of others are the same
    assert {build.file for build in builds} == LOOPS.keys()
    for build in builds:
        try:
            found = mixes(target, build)
        except CompilerMissing as error:
            pytest.skip(f"{error}; make gpu-check fetches what it can")
        for kernel, mix in found.items():
            assert mix.multiply_adds >= 128, (build.label, kernel)
            assert mix.share >= 0.95, (build.label, kernel, mix)


def test_a_missing_compiler_is_named(monkeypatch, capsys):
    def missing(target, build):
        raise CompilerMissing("nvdisasm is missing")

    monkeypatch.setattr("tools.gpu.mix.mixes", missing)
    assert main(["--targets", "sm_90"]) == 2
    assert capsys.readouterr().err == "sm_90 is not looked at: nvdisasm is missing\n"
