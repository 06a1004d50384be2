"""Find figures in the documents that older code gave. Each measurement is stored with a digest of
the files that decide a training, so that no release states figures of older code.

    python -m tools.provenance      # or make figures; fails if figures are of older code
"""

import hashlib
import json
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
# files that decide the numbers of a training, its evaluation and a capture
DECIDES = (
    "cl",
    *(f"pp_cl/{name}.py" for name in ("config", "evaluate", "presets", "run", "settings")),
    *(f"pp_cl/{name}" for name in ("engine", "metrics", "scene", "session")),
    "pp_studio/capture",
)
KINDS = (".py", ".cl", ".h", ".npz", ".json")


def digest(root: Path = ROOT) -> str:
    """Hex digest of the files that decide a training in a checkout."""
    files = [file for place in DECIDES for file in _files(root / place)]
    hasher = hashlib.sha256()
    for file in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
        if file.suffix in KINDS:
            name, content = file.relative_to(root).as_posix(), file.read_bytes()
            hasher.update(f"{name} {len(content)} ".encode() + content)
    return hasher.hexdigest()[:16]


def _files(place):
    return [place] if place.is_file() else [file for file in place.rglob("*") if file.is_file()]


def sentence(results: dict) -> str:
    """The sentence that states the commit, date, machine and method of a file of results."""
    text = f"Commit {results['commit']}, {results['date']}, {results['machine']}"
    return text + (f"; {results['how']}." if results.get("how") else ".")


def older(folder: Path, now: str) -> list[str]:
    """A line for each file of results in a folder whose code is not `now`, a digest()."""
    files = {path: json.loads(path.read_text("utf-8")) for path in sorted(folder.rglob("*.json"))}
    return [
        f"{path}: of commit {results['commit']}, before the last change to what decides a training;"
        " measure it again with `make readme` or `make results`"
        for path, results in files.items()
        if results["decides"] != now
    ]


def main(root: Path = ROOT) -> int:
    """Print which figures are older than the code; returns the exit status."""
    lines = older(root / "docs" / "results", digest(root))
    print(*lines, sep="\n", end="\n" if lines else "", file=sys.stderr)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
