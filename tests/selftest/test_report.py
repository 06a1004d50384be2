"""What is printed and stored of the selftest."""

import json

import numpy as np

from pp_cl.selftest.report import HEAD, as_json, line, setup
from pp_cl.selftest.run import Row

GOOD = Row("a: good", 1.25e-7, 1e-6, True, "", 0.5)
NAN = Row("a: bad", np.inf, 1e-6, False, "NaN", 0.25)
RAISED = Row("a: raised", None, None, False, "RuntimeError: no", 0.25)


def test_setup_names_what_a_report_needs(dev, monkeypatch):
    monkeypatch.setenv("PYOPENCL_BUILD_OPTIONS", "-cl-opt-disable")
    named = setup(dev)
    assert dev.name in named["device"] and dev.info["driver"] == named["driver"]
    assert named["platform"] == dev.info["platform"] and named["OpenCL"] == dev.info["version"]
    assert named["build options"].startswith("-cl-std=CL1.2")
    assert named["build options"].endswith(" -cl-opt-disable")
    assert all(text and "\n" not in text for text in named.values())


def test_lines():
    assert HEAD.split() == ["case", "worst", "error", "bound", "pass"]
    assert line(GOOD).split() == ["a:", "good", "1.2e-07", "1e-06", "yes"]
    assert line(NAN).split() == ["a:", "bad", "inf", "1e-06", "NO", "NaN"]
    assert line(RAISED).splitlines()[1].strip() == "RuntimeError: no"
    assert line(RAISED).split()[2:5] == ["-", "-", "NO"]


def test_json_has_every_row(dev):
    stored = json.loads(json.dumps(as_json(dev, [GOOD, NAN, RAISED]), allow_nan=False))
    assert stored["setup"] == setup(dev) and stored["seconds"] == 1.0 and not stored["passed"]
    assert [row["error"] for row in stored["cases"]] == [1.25e-7, None, None]
    assert stored["cases"][2] == vars(RAISED)
    assert as_json(dev, [GOOD])["passed"]
