"""What a command must leave after a fault: its words, what its run's folder holds, the verdict."""

import json
import re
import shutil
from pathlib import Path

from pp_cl.errors import UserError
from pp_cl.files.checkpoint import load_checkpoint
from pp_cl.files.image import read_rgba
from pp_cl.files.run_folder import read_row
from tools.injection.worker import Outcome

# every mechanism of the loop is due in 60 steps; small, so that a case takes little
SETTINGS = {
    "train.iterations": 60,
    "points.count": 500,
    "network.widths": "16,16,16",
    "network.blocks": "single",
    "train.crop": 0,
    "train.prune_every": 20,
    "train.checkpoint_every": 20,
    "train.log_every": 10,
    "train.previews": 2,
    "train.final_prune_weight": 0.5,
}
VIEWS, SIZE = 4, 16  # of the scene; its images are square
TIMES = ("seconds", "seconds_per_frame")  # what no two runs have in common
BESIDE = (".lock", ".owner", ".evaluation")  # marks without content of their own
LEFTOVER = re.compile(r"\..*\.tmp")
PREVIEW = re.compile(r"previews/step_\d+\.png")


def train_words(scene: Path, run: Path, **changes: object) -> list[str]:
    """Command line of the training; changes: train__iterations=100."""
    settings = SETTINGS | {name.replace("__", "."): value for name, value in changes.items()}
    sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    return ["train", str(scene), "--out", str(run), *sets]


def eval_words(run: Path) -> list[str]:
    """Command line of the evaluation."""
    return ["eval", str(run), "--save-images"]


def copied(begin: Path | None, run: Path) -> None:
    """Make `run` a copy of the folder `begin`, or nothing at all."""
    shutil.rmtree(run, ignore_errors=True)
    if begin:
        shutil.copytree(begin, run)


def content(run: Path) -> dict[str, bytes]:
    """{path below the run: bytes, times left out} of all files under final names."""
    files = {}
    for path in sorted(p for p in run.rglob("*") if p.is_file()):
        name, data = path.relative_to(run).as_posix(), path.read_bytes()
        if LEFTOVER.match(path.name) or name in BESIDE:
            continue
        if path.name == "log.jsonl":
            rows = [_timeless(json.loads(line)) for line in data.splitlines(True) if _is_row(line)]
            data = json.dumps(rows).encode()
        elif path.name == "metrics.json" and _problem(path) is None:
            data = json.dumps(_timeless(json.loads(data))).encode()
        files[name] = data
    return files


def _timeless(row):
    return {name: value for name, value in row.items() if name not in TIMES}


def _is_row(line):
    return line.endswith(b"\n") and read_row(line) is not None


def leftovers(run: Path) -> list[str]:
    """Temporary files in a run."""
    return [str(p.relative_to(run)) for p in run.rglob("*") if LEFTOVER.match(p.name)]


def half_written(run: Path) -> list[str]:
    """A line for each file under a final name that is not whole. The last row of a log may be."""
    paths = [p for p in run.rglob("*") if p.is_file() and p.name not in BESIDE]
    found = [(path, _problem(path)) for path in paths if not LEFTOVER.match(path.name)]
    return [f"{path.relative_to(run)}: {problem}" for path, problem in found if problem]


def _problem(path):
    """What is wrong with a file, None where nothing is."""
    try:
        if path.suffix == ".npz":
            load_checkpoint(path)
        elif path.suffix == ".png":
            read_rgba(path)
        elif path.suffix == ".json":
            json.loads(path.read_bytes())
        elif path.suffix == ".jsonl":
            whole = path.read_bytes().split(b"\n")[:-1]
            broken = [n for n, line in enumerate(whole, 1) if read_row(line) is None]
            return f"line {broken[0]} is no row" if broken else None
        else:
            return "unknown file"
    except (UserError, ValueError) as error:
        return str(error)
    return None


def differences(run: Path, expected: dict[str, bytes]) -> list[str]:
    """A line for each file that differs; an early preview, for which the clock asks, may be new."""
    found = content(run)
    names = [n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n)]
    names = [n for n in names if n in expected or not PREVIEW.fullmatch(n)]
    words = {True: "differs", False: "is missing"}
    return [f"{n} {words[n in found] if n in expected else 'is new'}" for n in sorted(names)]


def complaints(outcome: Outcome, statuses: tuple[int, ...]) -> list[str]:
    """What is wrong with how a command ended. It may print warnings, but of its end one line."""
    lines = outcome.errors.splitlines()
    told = [line for line in lines if line.startswith("pp-cl")]
    found = []
    if outcome.status not in statuses:
        found.append(f"status {outcome.status}")
    if "Traceback" in outcome.errors or "Exception ignored" in outcome.errors:
        found.append("a traceback")
    if outcome.status > 0 and (len(told) != 1 or lines[-1] != told[0]):
        found.append(f"{len(told)} lines tell of it")
    return [f"{what} ({' / '.join(lines[-3:])})" for what in found]
