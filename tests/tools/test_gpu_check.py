"""tools/gpu_check.py: what fails it, and what it writes."""

import json

import pytest

from tools import gpu_check
from tools.docs_tables import table
from tools.gpu import known
from tools.gpu.builds import Build
from tools.gpu.compilers import BuildError, Usage
from tools.gpu.packages import CompilerMissing
from tools.gpu_check import TARGETS, main

BUILD = Build("a/b", ("X=1",))
GOOD = {"sm_90": Usage(60, 0, 0, 0), "gfx1100": Usage(50, 0, 0, 64), "dg2": Usage(128, 0, 0, 0, 16)}


@pytest.fixture
def usage(tmp_path, monkeypatch):
    """{target: what the one kernel takes, or the error of its build}, all good at first."""
    usage = dict(GOOD)

    def build(target, build, sources, compilers):
        assert (build, compilers) == (BUILD, f"compiler of {target}")
        if isinstance(usage[target], Exception):
            raise usage[target]
        return {"k": usage[target], "unused": Usage(255, 9, 9, 99999)}

    def version(target):
        if isinstance(usage[target], CompilerMissing):
            raise usage[target]
        return f"compiler of {target}"

    monkeypatch.setattr(gpu_check, "cached_build", build)
    monkeypatch.setattr(gpu_check, "version", version)
    monkeypatch.setattr(gpu_check, "unpack_missing", lambda: "no apt-get here")
    monkeypatch.setattr(gpu_check, "read_builds", lambda: {BUILD: {"k"}})
    monkeypatch.setattr(gpu_check, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(known, "FILE", tmp_path / "known.json")
    known.write_known({})
    return usage


def test_nothing_to_complain_of(usage, capsys):
    assert main([]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        "a/b X=1: k",
        "    dg2: registers 128, simd 16",
        "    gfx1100: registers 50, local 64",
        "    sm_90: registers 60",
    ]
    assert err.splitlines()[-1].startswith("3 kernels for sm_90, gfx1100, dg2: 0 known")


@pytest.mark.parametrize(
    ("target", "found", "line"),
    [
        ("sm_90", Usage(255, 8, 0, 0), "sm_90 a/b X=1: k: spill 8"),
        ("gfx1100", Usage(50, 0, 4, 0), "gfx1100 a/b X=1: k: private 4"),
        ("sm_90", Usage(129, 0, 0, 0), "sm_90 a/b X=1: k: registers 129"),
        ("dg2", Usage(128, 0, 0, 0, 8), "dg2 a/b X=1: k: narrow 8"),
        ("dg2", Usage(128, 0, 0, 32772, 16), "dg2 a/b X=1: k: 32772 bytes of local memory"),
        ("gfx1100", BuildError("undefined: f"), "does not build or link: undefined: f"),
    ],
)
def test_what_fails(usage, capsys, target, found, line):
    usage[target] = found
    assert main([]) == 1
    assert line in capsys.readouterr().err
    assert main(["--targets", "sm_90" if target != "sm_90" else "dg2"]) == 0


def test_what_is_known_passes_until_it_is_gone(usage, capsys):
    known.write_known({"sm_90 a/b X=1: k": {"spill": 8}})
    usage["sm_90"] = Usage(60, 8, 0, 0)
    assert main([]) == 0
    usage["sm_90"] = Usage(60, 9, 0, 0)
    assert main([]) == 1
    assert "spill 9, known with 8" in capsys.readouterr().err
    usage["sm_90"] = GOOD["sm_90"]
    assert main([]) == 1
    assert "spill is in known.json and no longer true" in capsys.readouterr().err
    assert main(["--targets", "dg2"]) == 0  # nothing is known of what was not compiled


def test_a_kernel_that_the_compiler_forgets(usage, capsys, monkeypatch):
    monkeypatch.setattr(gpu_check, "read_builds", lambda: {BUILD: {"k", "other"}})
    assert main([]) == 1
    assert "sm_90 a/b X=1: its compiler does not name other" in capsys.readouterr().err


def test_a_missing_compiler_is_named_and_the_rest_checked(usage, capsys):
    usage["sm_90"] = CompilerMissing("ptxas is missing: install it")
    assert main([]) == 2
    out, err = capsys.readouterr()
    assert "sm_90 is not checked: ptxas is missing: install it (no apt-get here)" in err
    assert "2 kernels for gfx1100, dg2" in err
    assert "gfx1100: registers 50" in out
    usage["dg2"] = Usage(128, 1, 0, 0, 16)
    assert main([]) == 1


def test_other_targets_fail_by_errors_and_local_memory_only(usage):
    usage["sm_80"] = Usage(255, 8, 8, 32768)
    assert main(["--targets", "sm_80"]) == 0
    usage["sm_80"] = Usage(20, 0, 0, 32769)
    assert main(["--targets", "sm_80"]) == 1


def test_it_writes_the_table_and_shortens_the_list(usage):
    known.write_known({"sm_90 a/b X=1: k": {"spill": 8, "private": 4}, "dg2 c: k": {"spill": 1}})
    usage["sm_90"] = Usage(60, 7, 0, 0)
    assert main(["--write"]) == 0
    assert known.read_known() == {"sm_90 a/b X=1: k": {"spill": 7}}
    lines = table(json.loads(gpu_check.RESULTS.read_text())).splitlines()
    assert lines[0].startswith("What each kernel takes on GPUs, by compiler of dg2; compiler of gf")
    assert lines[-1] == "| a/b X=1 | k | 60 | 7 |  | 50 |  |  | 16 |  |  |"


def test_it_writes_nothing_by_halves(usage):
    for name, changed in (("dg2", CompilerMissing("gone")), ("sm_90", BuildError("no"))):
        usage.update(GOOD | {name: changed})
        assert main(["--write"]) in (1, 2)
    assert main(["--write", "--targets", "gfx1100"]) == 0
    assert not gpu_check.RESULTS.exists()
    assert len(TARGETS) == 3
