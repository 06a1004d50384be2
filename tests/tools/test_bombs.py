"""Files that unfold to more memory than there is are refused in one line, within bounds."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tools.bombs import KINDS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
MOST_MIB = 512


@pytest.fixture(scope="module")
def measured():
    """{kind: what tools/bombs.py measures}."""
    words = [sys.executable, "-m", "tools.bombs"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    return {row["kind"]: row for row in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bomb_is_one_line_and_little_memory(measured, kind):
    row, status = measured[kind], KINDS[kind][2]
    assert row["status"] == status and row["mib"] < MOST_MIB, row
    if status == 2:
        named = kind.split(",")[0]
        assert row["message"].startswith("pp-cl: ") and "\n" not in row["message"]
        assert "." not in named or f"{named}: " in row["message"], row
