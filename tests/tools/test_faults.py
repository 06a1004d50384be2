"""tools/faults.py: some faults of each kind, and that it finds what is wrong."""

import json
import shutil
import sys
from contextlib import contextmanager

import pytest

from tools import faults
from tools.injection.bench import Case, Tally
from tools.injection.scenarios import SCENARIOS, fail_calls
from tools.injection.trial import complaints, content, differences, half_written, leftovers
from tools.injection.worker import Outcome

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux") or not shutil.which("cc"), reason="needs Linux and cc"
)
FAILING = [
    "mkdir previews",
    "open .config.json",
    "write log.jsonl",
    "write .checkpoint.npz",
    "fsync .checkpoint.npz",
    "rename checkpoint.npz",
    "fsync .",
    "remove .owner",
]


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A training from its beginning, where one case at a time is tried."""
    folder = tmp_path_factory.mktemp("faults").resolve()
    with faults.opened_bench(folder, places=1) as bench:
        yield Case(bench, None, bench.train)


def last(case, beginning):
    """The number of a call from 1 on."""
    return max(n for n, call in enumerate(case.calls, 1) if call.startswith(beginning))


def test_a_failing_call_is_one_line_and_the_next_start_ends_at_the_same_bytes(case):
    tally = fail_calls(case, "calls", [last(case, beginning) for beginning in FAILING])
    assert tally.findings == []
    # the name of the owner is of no use any more
    assert (tally.tried, tally.stopped, tally.went_on) == (8, 7, 1)


@pytest.mark.slow
def test_other_bytes_at_the_end_are_found(case):
    other = Case(case.bench, None, case.words)
    other.expected["log.jsonl"] += b"more"
    number = last(case, "rename log.jsonl")
    (found,) = fail_calls(other, "calls", [number]).findings
    assert found == f"calls, call {number} (rename log.jsonl): the next start: log.jsonl differs"


def test_a_process_that_is_killed_in_front_of_a_call(case):
    place = case.bench.places[0]
    outcome = case.disturb(place, in_child=True, call=last(case, "rename checkpoint.npz"))
    assert outcome.status == -9 and outcome.calls[-1] == "! rename checkpoint.npz"
    (left,) = leftovers(place.run_folder)
    assert left.startswith(".checkpoint.npz.")
    assert case.after(place, may_leave=True) == []


# --------------------------------------------------------------------------------------------------


def test_half_written_files_and_other_ones_are_found(case, tmp_path):
    run, whole = tmp_path / "run", case.bench.trained
    shutil.copytree(whole, run)
    assert half_written(run) == [] and differences(run, content(whole)) == []
    log = (run / "log.jsonl").read_bytes()
    (run / "log.jsonl").write_bytes(log[:-9])  # its last row may be half there
    assert half_written(run) == []
    assert differences(run, content(whole)) == ["log.jsonl differs"]
    (run / "log.jsonl").write_bytes(log[9:])
    for name in ("checkpoint.npz", "config.json", "previews/step_000060.png"):
        data = (run / name).read_bytes()
        (run / name).write_bytes(data[: len(data) // 2])
    (run / "odd").write_bytes(b"")
    (run / ".a.7.tmp").write_bytes(b"")
    names = ["checkpoint.npz", "config.json", "log.jsonl", "odd", "previews/step_000060.png"]
    assert sorted(line.partition(":")[0] for line in half_written(run)) == names
    assert leftovers(run) == [".a.7.tmp"]
    (run / "config.json").unlink()
    (run / "previews" / "step_000007.png").write_bytes(b"")
    told = ["checkpoint.npz differs", "config.json is missing", "log.jsonl differs", "odd is new"]
    assert differences(run, content(whole)) == [*told, "previews/step_000060.png differs"]


@pytest.mark.parametrize(
    "status, errors, found",
    [
        (2, "pp-cl: a: no space\n", []),
        (2, "step 5\npp-cl: a: no space\n", []),
        (0, "pp-cl: a warning\npp-cl: another\n", []),
        (1, "pp-cl: a\n", ["status 1"]),
        (2, "", ["0 lines"]),
        (2, "pp-cl: a\npp-cl: b\n", ["2 lines"]),
        (2, "pp-cl: a\nmore\n", ["1 lines"]),
        (0, "Exception ignored in: x\n", ["a traceback"]),
        (1, "Traceback (most recent call last):\n", ["status 1", "a traceback", "0 lines"]),
    ],
)
def test_how_a_command_must_end(status, errors, found):
    lines = complaints(Outcome(status, "", errors, [], 0.0), (0, 2))
    assert len(lines) == len(found)
    assert all(line.startswith(start) for line, start in zip(lines, found, strict=True))


@pytest.fixture
def planted(tmp_path, monkeypatch):
    """[tallies of a scenario]; the tool's other parts stand still."""

    @contextmanager
    def opened(folder, **numbers):
        yield None

    tallies = []
    monkeypatch.setattr(faults, "opened_bench", opened)
    monkeypatch.setattr(faults, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(faults, "SCENARIOS", {"one": lambda bench: iter(tallies)})
    return tallies


def test_a_finding_is_exit_status_1_and_in_the_table(planted, tmp_path, capsys):
    planted.append(Tally("SIGKILL", tried=3, stopped=2, went_on=1))
    assert faults.main(["--only", "one", "--write"]) == 0
    planted.append(Tally("full disk", tried=1, stopped=1, findings=["full disk, 8 KiB: odd"]))
    assert faults.main(["--only", "one", "--write"]) == 1
    out = capsys.readouterr().out
    assert "full disk, 8 KiB: odd" in out and out.endswith("4 cases, 1 findings\n")
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [(row["fault"], row["tried"], row["found"]) for row in rows] == [
        ("SIGKILL", 3, 0),
        ("full disk", 1, 1),
    ]


def test_what_cannot_run_is_told(planted, monkeypatch, capsys):
    def missing(*_, **__):
        raise FileNotFoundError(2, "No such file or directory", "cc")

    monkeypatch.setattr(faults, "opened_bench", missing)
    assert faults.main(["--only", "one"]) == 2
    assert "needs Linux and cc" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        faults.main(["--only", "two"])
    assert stopped.value.code == 2
    assert "clock" in SCENARIOS
