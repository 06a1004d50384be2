import json
import shutil

import pytest

from pp_cl.cli import main
from pp_cl.engine.device import device as device_module
from pp_cl.selftest import run

NAMES = ("device: scan", "training: split opacities", "training: moving average")


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(run, "CASES", [c for name in NAMES for c in run.CASES if c.name == name])


def test_all_pass(few, dev, tmp_path, capsys):
    assert main(["selftest", "--json", str(tmp_path / "a.json")]) == 0
    out, err = capsys.readouterr()
    assert not err
    lines = out.splitlines()
    facts = dict(line.split(maxsplit=1) for line in lines[: lines.index("")] if "build" not in line)
    assert dev.name in facts["device"] and facts["driver"] == dev.info["driver"]
    assert "build options -cl-std=CL1.2" in out
    assert [line.endswith("yes") for line in lines if line.startswith(NAMES)] == [True] * 3
    assert lines[-1].startswith("3 cases in") and lines[-1].endswith("3 pass")
    stored = json.loads((tmp_path / "a.json").read_text())
    assert stored["passed"] and [row["case"] for row in stored["cases"]] == list(NAMES)


def test_a_naive_formula_in_a_kernel_is_status_1_and_named(few, dev, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dev, "_programs", {})
    shutil.copytree(device_module.kernel_folder(), tmp_path / "cl")
    path = tmp_path / "cl" / "training" / "refine.cl"
    text, o = path.read_text(), "opacity[OPACITIES * (size_t)i]"
    assert text.count(f"1.0f + sqrt(1.0f - {o})") == 1
    path.write_text(text.replace(f"1.0f + sqrt(1.0f - {o})", f"{o} / (1.0f - sqrt(1.0f - {o}))"))
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path / "cl")
    assert main(["selftest", "--json", str(tmp_path / "a.json")]) == 1
    out, err = capsys.readouterr()
    assert err == "pp-cl: selftest: 1 failed: training: split opacities\n"
    assert out.splitlines()[-1].endswith("2 pass")
    stored = json.loads((tmp_path / "a.json").read_text())
    assert [row["passed"] for row in stored["cases"]] == [True, False, True]
    assert main(["selftest", "--hard"]) == 1
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith(NAMES[1]))
    assert "NO" in line.split()


def test_hard_cases_alone_stand_beside_naive_formulas(few, dev, tmp_path, capsys):
    assert main(["selftest", "--hard", "--json", str(tmp_path / "a.json")]) == 0
    stored = json.loads((tmp_path / "a.json").read_text())["cases"]
    assert [row["case"] for row in stored] == list(NAMES[:2])
    lines = capsys.readouterr().out.splitlines()
    for row in stored:
        (line,) = (line for line in lines if line.startswith(row["case"]))
        hard = row["hard"]
        naive = f"{hard['naive']:{'.2g' if hard['bound'] else '.0f'}}"
        assert line.endswith(hard["what"]) and naive in line.split()
        assert hard["error"] <= hard["bound"] < hard["naive"]
