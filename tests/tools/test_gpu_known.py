"""tools/gpu/known.py: what is complained of; the list only becomes shorter."""

import json

import pytest

from tools.gpu import known
from tools.gpu.builds import read_builds
from tools.gpu.compilers import Usage
from tools.gpu.known import complaints, leftovers, news, read_known, shortened, write_known
from tools.gpu_check import RESULTS, TARGETS

# Lower them when the list has become shorter.
MOST_KERNELS, MOST_COMPLAINTS = 30, 37

ROWS = json.loads(RESULTS.read_text("utf-8"))["rows"]


def usage_of(row, target):
    """Usage of a row of the table; numbers that are 0 are left out there."""
    names = ("registers", "spill", "private", "local")
    numbers = {name: row.get(f"{target}_{name}", 0) for name in names}
    return Usage(**numbers, simd=row.get(f"{target}_simd"))


@pytest.mark.parametrize(
    ("usage", "expected"),
    [
        (Usage(128, 0, 0, 32768), {}),
        (Usage(129, 0, 0, 0), {"registers": 129}),
        (Usage(20, 4, 8, 0), {"spill": 4, "private": 8}),
        (Usage(256, 0, 0, 0, 16), {}),
        (Usage(128, 3, 0, 0, 8), {"spill": 3, "narrow": 8}),
    ],
)
def test_complaints(usage, expected):
    assert complaints(usage) == expected


def test_news_and_leftovers():
    stored = {"a": {"spill": 3, "private": 8}, "b": {"registers": 160}}
    assert news(stored, stored) == leftovers(stored, stored) == []
    assert news({"a": {"spill": 4, "narrow": 8}}, stored) == [
        "a: spill 4, known with 3",
        "a: narrow 8",
    ]
    assert news({"b": {"registers": 170}}, stored) == []  # as from one run to the next
    assert news({"b": {"registers": 171}}, stored) == ["b: registers 171, known with 160"]
    assert news({"c": {"spill": 1}}, stored) == ["c: spill 1"]
    assert news({"a": {"spill": 2}}, stored) == []
    assert leftovers({"a": {"spill": 2}}, stored) == [
        "a: private is in known.json and no longer true",
        "b: registers is in known.json and no longer true",
    ]


def test_it_becomes_shorter_and_never_longer(tmp_path, monkeypatch):
    monkeypatch.setattr(known, "FILE", tmp_path / "known.json")
    stored = {"a": {"spill": 3, "private": 8}, "b": {"registers": 140}, "c": {"spill": 1}}
    found = {"a": {"spill": 2, "narrow": 8}, "c": {"spill": 9}, "d": {"spill": 1}}
    write_known(shortened(found, stored))
    assert read_known() == {"a": {"spill": 2}, "c": {"spill": 1}}


def test_the_list_has_not_grown():
    stored = read_known()
    assert len(stored) <= MOST_KERNELS
    assert sum(map(len, stored.values())) <= MOST_COMPLAINTS


def test_the_list_is_what_the_table_shows():
    shown = {
        f"{target} {row['build']}: {row['kernel']}": found
        for row in ROWS
        for target in TARGETS
        if (found := complaints(usage_of(row, target)))
    }
    stored = read_known()
    assert news(shown, stored) == leftovers(shown, stored) == []


def test_the_table_has_all_builds():
    launched = {(b.label, kernel) for b, kernels in read_builds().items() for kernel in kernels}
    assert {(row["build"], row["kernel"]) for row in ROWS} == launched
    assert all(row[f"{target}_registers"] > 0 for row in ROWS for target in TARGETS)
