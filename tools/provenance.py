"""Of which code a figure in the documents is: a digest of all that decides a training, which is
stored with each measurement, so that a page can say where the code has changed since, and that no
release states such figures.

    python -m tools.provenance      # or make figures; fails where figures are of older code
"""

import hashlib
import io
import json
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
# what decides the numbers of a training, its evaluation and a capture
DECIDES = (
    "cl",
    *(f"pp_cl/{name}.py" for name in ("config", "evaluate", "presets", "run", "settings")),
    *(f"pp_cl/{name}" for name in ("engine", "metrics", "scene", "session")),
    "pp_studio/capture",
)
KINDS = (".py", ".cl", ".h", ".npz", ".json")


def digest(root: Path = ROOT) -> str:
    """Hex digest of what decides a training in a checkout."""
    files = [file for place in DECIDES for file in _files(root / place)]
    return _digest((file.relative_to(root).as_posix(), file.read_bytes()) for file in files)


def digest_at(commit: str) -> str:
    """The same of a commit of this repository."""
    packed = subprocess.run(
        [shutil.which("git") or "git", "archive", commit], cwd=ROOT, check=True, capture_output=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        members = {m.name: m for m in archive.getmembers() if m.isfile()}
        chosen = [name for name in members if _decides(name)]
        return _digest((name, archive.extractfile(members[name]).read()) for name in chosen)


def _files(place):
    return [place] if place.is_file() else [file for file in place.rglob("*") if file.is_file()]


def _decides(name):
    return any(name == place or name.startswith(f"{place}/") for place in DECIDES)


def _digest(contents: Iterable[tuple[str, bytes]]) -> str:
    found = hashlib.sha256()
    for name, content in sorted(contents):
        if name.endswith(KINDS):
            found.update(f"{name} {len(content)} ".encode() + content)
    return found.hexdigest()[:16]


def sentence(results: dict, now: str) -> str:
    """Of which commit, machine and way a file of results is. now: digest() of the present code."""
    said = f"Commit {results['commit']}, {results['date']}, {results['machine']}"
    said += f"; {results['how']}." if results.get("how") else "."
    later = " Later commits have changed what decides a training."
    return said + (later if results["decides"] != now else "")


def older(folder: Path, now: str) -> list[str]:
    """A line for each file of results in a folder that is of other code than now, a digest()."""
    files = {path: json.loads(path.read_text("utf-8")) for path in sorted(folder.rglob("*.json"))}
    return [
        f"{path}: of commit {results['commit']}, before the last change to what decides a training;"
        " measure it again with `make readme` or `make results`"
        for path, results in files.items()
        if results["decides"] != now
    ]


def main(root: Path = ROOT) -> int:
    """Print what is older than the code; returns the exit status."""
    found = older(root / "docs" / "results", digest(root))
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
