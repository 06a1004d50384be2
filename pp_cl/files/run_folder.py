"""The folder of a run: its file names, config, checkpoint, log and lock."""

import json
import math
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pp_cl.errors import UserError, name_of, pasted, shown
from pp_cl.files.atomic import check_ours, is_owned, own, remove_ours, told, write_text
from pp_cl.files.untrusted import read_json_text, read_regular, refusal, strict_json

MASKS_SHEET = "masks.png"
MADE = "run"  # in the folder that `pp-cl make` fills
MOST_OWNER = 1000  # bytes of the line that names the owner
MOST_METRICS = 2**26  # bytes of a metrics.json; a view takes a few hundred
MOST_LOG = 2**25  # bytes of a log: 80,000 rows
MOST_LINE = 2**16  # bytes of a row; pp-cl writes no longer ones
MOST_NUMBER = 1e300  # in a row
GOES_ON = "; the same command goes on"
MOST_LEVELS = 4  # of nested lists and dictionaries in a row
NUMBERS = ("loss", "psnr", "points")  # values of a row that commands read, beside step and seconds


class RunFolder:
    """The paths in a run's folder `path`: config, checkpoint, log and previews. None need exist."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.config = self.path / "config.json"
        self.checkpoint = self.path / "checkpoint.npz"
        self.log = self.path / "log.jsonl"
        self.previews = self.path / "previews"

    def __str__(self) -> str:
        return str(self.path)

    @property
    def name(self) -> str:
        """The run's name: its folder's, or that of the folder around it that `pp-cl make` fills."""
        is_part = self.path.name == MADE and is_owned(self.path.parent)
        return name_of(self.path.parent if is_part else self.path)

    def member(self, number: int) -> "RunFolder":
        """The folder of another member; numbers start at 2."""
        return RunFolder(self.path / f"member-{number}")

    def evaluation(self, split: str, size: int = 0) -> Path:
        """Folder of the evaluation of a split: eval for test, eval/SPLIT for others; within it
        size-SIZE for views of another size than in the training.
        """
        folder = self.path / "eval" if split == "test" else self.path / "eval" / split
        return folder / f"size-{size}" if size else folder

    def metrics(self, split: str) -> Path:
        """The file with the results of a split's evaluation."""
        return self.evaluation(split) / "metrics.json"

    def measured(self) -> dict[str, Any] | None:
        """{"mean": {metric: value}, "step", "finished", "points", "device"} from the evaluation of
        the test split, or None without one. Raises UserError if its file is broken.
        """
        file = self.metrics("test")
        if not file.exists():
            return None
        try:
            result = strict_json(read_json_text(file, MOST_METRICS))
            results = {name: result[name] for name in ("mean", "step", "finished", "device")}
            results["points"] = result["points"]["final"]
            kinds = {"step": int, "finished": bool, "points": int, "device": str}
            if any(type(results[name]) is not kind for name, kind in kinds.items()):
                raise ValueError("values of another kind")
            if not all(math.isfinite(value) for value in results["mean"].values()):
                raise ValueError("infinite values")
            return results
        except Exception as error:  # the file may hold anything
            raise refusal(
                file, error, "metrics", f"run `pp-cl eval {pasted(self)}` again"
            ) from None

    def check_usable(self) -> None:
        """Raise UserError if the folder is a file, or holds files that belong to no run."""
        if self.path.exists() and not self.path.is_dir():
            raise UserError(f"{self}: is not a folder; choose another --out")
        if self.config.exists() or not self.path.exists():
            return
        if any(not p.name.startswith(".") for p in self.path.iterdir()):
            raise UserError(
                f"{self}: holds other files and no config.json; choose an empty or new folder for"
                " --out"
            )

    @contextmanager
    def owned(self) -> Iterator[None]:
        """While the block runs, no other process trains into the folder, which is created if it is
        missing. Raises UserError naming the process that owns the folder.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        owner, lock = self.path / ".pp-cl.owner", FileLock(self.path / ".pp-cl.lock", timeout=0)
        try:
            lock.acquire()
        except Timeout:
            try:
                who = shown(read_regular(owner, MOST_OWNER))
            except (OSError, ValueError):
                who = "another process"
            raise UserError(
                f"{self}: {who} trains into it; wait until it ends, or choose another --out"
            ) from None
        except OSError as error:
            raise UserError(
                f"{lock.lock_file}: cannot be locked ({error.strerror}); check the file system"
            ) from error
        try:
            with told(owner):
                owner.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
            yield
        finally:
            with suppress(OSError):
                owner.unlink(missing_ok=True)
            with suppress(OSError):  # the system releases it when the process ends
                lock.release()

    def check_sheets(self, step: int) -> None:
        """Raise UserError naming an image that training from this step would overwrite and that no
        training has written as it is now.
        """
        begun = "" if step == 0 else f"step_{step:06d}.png"
        previews = [file for file in self.previews.glob("step_*.png") if file.name > begun]
        check_ours([self.path / MASKS_SHEET] * (step == 0) + previews)

    def create(self, config_json: str) -> None:
        """Create the folders, remove images that belong to no checkpoint, write config.json."""
        own(self.path)
        if not self.checkpoint.exists():
            remove_ours([self.path / MASKS_SHEET, *self.previews.glob("step_*.png")])
        self.configure(config_json)
        self.previews.mkdir(exist_ok=True)

    def configure(self, config_json: str) -> None:
        """Write config.json."""
        write_text(self.config, config_json + "\n")

    def rows(self) -> list[dict[str, Any]]:
        """The rows of the log, up to the first broken one. Raises UserError if it is too long."""
        return _rows(self.log)

    def open_log(self, step: int) -> "Log":
        """The log, cut off after `step`: training writes later rows again."""
        return Log(self.log, step)


class Log:
    """A file with one JSON object per logged step. seconds: training time up to its last row."""

    def __init__(self, path: Path, step: int) -> None:
        rows = _rows(path, step)
        write_text(path, "".join(json.dumps(row) + "\n" for row in rows))
        self.seconds = rows[-1]["seconds"] if rows else 0.0
        # unbuffered, so that closing does not repeat a failed write
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115

    def __enter__(self) -> "Log":
        return self

    def __exit__(self, *_: object) -> None:
        with told(self._file.name, then=GOES_ON):
            self._file.close()

    def write(self, row: dict[str, Any]) -> None:
        """Append a row. Raises UserError naming a file that cannot be written, and ValueError for
        NaN.
        """
        data = (json.dumps(row, allow_nan=False) + "\n").encode()
        with told(self._file.name, then=GOES_ON):
            while data:
                data = data[self._file.write(data) :]


def read_row(line: bytes | str) -> dict[str, Any] | None:
    """The row in a line of a log, with finite numbers, and "step" and "seconds" of at least 0; None
    if a kill or a fault left anything else.
    """
    try:
        row = strict_json(line) if len(line) <= MOST_LINE else {}
        numbers = [row["step"], row["seconds"], *(row.get(name, 0) for name in NUMBERS)]
        is_row = type(numbers[0]) is int and all(type(n) in (int, float) for n in numbers)
        is_row = is_row and min(numbers[:2]) >= 0 and type(row.get("device", "")) is str
        return row if is_row and _is_loggable(row) else None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None


def _is_loggable(value, levels=MOST_LEVELS):
    """Whether a JSON value can be written again: no number is huge and lists nest at most `levels`
    deep.
    """
    if isinstance(value, (list, dict)):
        inside = value.values() if isinstance(value, dict) else value
        return levels > 0 and all(_is_loggable(part, levels - 1) for part in inside)
    return not isinstance(value, (int, float)) or abs(value) < MOST_NUMBER


def _rows(path, step=math.inf):
    """The rows of a log before the first that is later than `step`, or finished (if a step is
    given), or broken. A broken row gets a warning, unless the log may be growing. Raises UserError
    if the log is too long.
    """
    size = path.stat().st_size if path.is_file() else 0
    if size > MOST_LOG:
        raise UserError(
            f"{path}: is larger than {MOST_LOG} bytes; move it away, and raise train.log_every"
        )
    rows, last = [], {"step": 0, "seconds": 0}
    for number, line in enumerate(path.read_bytes().splitlines(True) if size else (), 1):
        row = read_row(line)
        if row is None or any(row[name] < last[name] for name in last):
            if line.endswith(b"\n") or step < math.inf:
                warnings.warn(
                    f"{path}: line {number} is not a row of a log; it and all later lines are left"
                    " out",
                    stacklevel=2,
                )
            break
        if row["step"] > step or (step < math.inf and row.get("finished")):
            break
        rows.append(row)
        last = {name: row[name] for name in last}
    return rows
