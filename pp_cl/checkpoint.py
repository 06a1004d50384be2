"""The checkpoint of a run: a .npz of uncompressed arrays and a JSON header. Before memory is
allocated for an array, its size is compared with its part of the file and with the run's settings.
"""

import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pp_cl.engine.device.buffers import DeviceRows
from pp_cl.engine.grid import MOST_IDS, Grid
from pp_cl.engine.stored import stored_table
from pp_cl.engine.training.exposure import decided_at
from pp_cl.errors import Diverged, UserError, quoted, shown
from pp_cl.files.atomic import atomic_file
from pp_cl.files.run_folder import RunFolder
from pp_cl.files.untrusted import opened_zip, refusal, strict_json
from pp_cl.scene.identity import unpacked_views
from pp_cl.settings import Config

FORMAT = 4  # raised when the arrays change their meaning
MOST_HEADER = 2**24  # bytes; a view takes some 400
MOST_LENGTH = 1e30  # world units; float32 cannot hold products of larger lengths
# {key of the header: its types in JSON}; a header may lack the OPTIONAL ones
REQUIRED: dict[str, tuple] = dict.fromkeys(("step", "initial_points", "format"), (int,))
REQUIRED |= dict.fromkeys(("views", "depth_range"), (list,))
REQUIRED |= {"finished": (bool,), "grid": (dict,), "pixels": (dict, type(None))}
OPTIONAL: dict[str, tuple] = {"extended_from": (int,), "left_out": (list,), "notes": (list,)}
OPTIONAL |= {"specular": (bool,), "averaged": (bool,)}
OPTIONAL |= dict.fromkeys(("progress", "seconds", "passed"), (int, float))
OPTIONAL |= {"exposed": (str, bool)}  # true in runs of 0.3.0
MOST_SECONDS = 10**9  # of a training
MEND = "delete it to train again, or restore a copy"
OTHER_RUN = "its config.json may belong to another run"
Arrays = Mapping[str, np.ndarray | DeviceRows]


def save_checkpoint(path: Path, header: dict[str, Any], arrays: Arrays) -> None:
    """Write {name: array} and a JSON header as np.savez does, but without copying a whole array and
    without times. The SH coefficients of a finished run become float16 (docs/training.md). Raises
    Diverged for NaN and Inf, UserError for a header that is too large to be read.
    """
    text = json.dumps({"format": FORMAT, **header}, sort_keys=True).encode()
    if len(text) > MOST_HEADER:
        raise UserError(
            f"{path}: its header would have {len(text)} bytes, but at most {MOST_HEADER} can be"
            " read; train on fewer images"
        )
    is_finished = header.get("finished", False)
    with atomic_file(path, noted=False) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in {"header": np.frombuffer(text, np.uint8), **arrays}.items():
            is_rounded = is_finished and name.startswith("points.sh")
            dtype = np.dtype(np.float16) if is_rounded else array.dtype
            kind = np.lib.format.dtype_to_descr(dtype)
            facts = {"descr": kind, "fortran_order": False, "shape": tuple(array.shape)}
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, facts)
                for piece in _finite_pieces(name, array, dtype):
                    member.write(piece.reshape(-1).view(np.uint8).data)


def check_finite(arrays: Arrays) -> None:
    """Raise Diverged naming the first array that holds NaN or Inf."""
    for name, array in arrays.items():
        for _ in _finite_pieces(name, array, array.dtype):
            pass


def _finite_pieces(name, array, dtype):
    """Yield the rows of an array, some at a time. Raises Diverged for NaN and Inf."""
    for rows in [array] if isinstance(array, np.ndarray) else array.pieces():
        with np.errstate(over="ignore"):  # an overflow gives Inf, which is reported
            piece = np.ascontiguousarray(rows, dtype)
        if not _is_finite(piece):
            raise Diverged(f"{name} holds NaN or Inf")
        yield piece


def _is_finite(array):
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())


class Form(NamedTuple):
    """The shape and dtype of an array that is not read yet."""

    shape: tuple[int, ...]
    dtype: np.dtype

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


class Checkpoint:
    """An opened checkpoint. header: its JSON object; forms: {name: Form} of its arrays. Raises
    ValueError, and zipfile's exceptions, for a file that save_checkpoint() has not written.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path, self._archive = path, archive
        members = archive.infolist()
        if sum(info.file_size for info in members) > path.stat().st_size:
            raise ValueError("its arrays claim more bytes than the file holds")
        self.forms = {info.filename.removesuffix(".npy"): self._form(info) for info in members}
        text = self.forms.pop("header", None)
        if text is None or text.dtype != np.uint8 or math.prod(text.shape) > MOST_HEADER:
            raise ValueError("it has no header")
        self.header = strict_json(self._read("header").tobytes())
        if not isinstance(self.header, dict):
            raise ValueError("its header is no JSON object")
        if self.header.get("format") != FORMAT:
            number = quoted(self.header.get("format"), 40)
            raise UserError(
                f"{path}: format {number}, but this version reads {FORMAT}; train again"
            )

    def _form(self, info):
        """The Form of an array, which must be as large as its part of the file."""
        with self._archive.open(info) as member:
            if np.lib.format.read_magic(member) != (1, 0):  # others have headers of up to 4 GiB
                raise ValueError("holds an array of another version than 1.0")
            shape, _, dtype = np.lib.format.read_array_header_1_0(member)
            if member.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
                raise ValueError(f"{shown(info.filename, 40)} is not as large as {shape} {dtype}")
        return Form(shape, dtype)

    def _read(self, name):
        with self._archive.open(f"{name}.npy") as member:
            return np.lib.format.read_array(member, allow_pickle=False)

    def array(self, name: str) -> np.ndarray:
        """One of its arrays; float16 becomes float32. Raises UserError for NaN and Inf."""
        with _refused(self.path):
            array = self._read(name)
        if not _is_finite(array):
            raise UserError(f"{self.path}: {name} holds NaN or Inf; {MEND}")
        return array.astype(np.float32) if array.dtype == np.float16 else array


@contextmanager
def opened_run(folder: RunFolder, config: Config) -> Iterator[Checkpoint]:
    """The checkpoint in the folder of a run with these settings, opened until the block ends.
    Raises UserError naming the file if it is missing, broken, of another format, or not of this
    run.
    """
    path = folder.checkpoint
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; train first")
    with ExitStack() as stack:
        with _refused(path):
            stored = Checkpoint(path, stack.enter_context(opened_zip(path)))
        problem, mend = _problem_of_header(stored.header, config.train.iterations), MEND
        if not problem:
            problem, mend = _problem_of_forms(stored, config), OTHER_RUN
        if not problem:
            ids, grid = stored.array("points.ids"), stored.header["grid"]
            is_ascending = bool((ids[1:] > ids[:-1]).all())
            if not is_ascending or (Grid.of_header(grid).coordinates(ids) >= grid["dims"]).any():
                problem, mend = "points.ids must be vertices of its grid in ascending order", MEND
        if problem:
            raise UserError(f"{path}: {problem}; {mend}")
        yield stored


def progress_of(header: dict[str, Any], iterations: int) -> float:
    """The progress, from 0 to 1, of a training of so many iterations at its checkpoint."""
    return 1.0 if header["finished"] else header.get("progress", header["step"] / iterations)


def load_run_state(
    folder: RunFolder, config: Config
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, {name: array}) of opened_run()'s checkpoint."""
    with opened_run(folder, config) as stored:
        return stored.header, {name: stored.array(name) for name in stored.forms}


@contextmanager
def _refused(path):
    """Turn exceptions into UserErrors; zipfile raises all kinds of them on broken bytes."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise refusal(path, error, "a checkpoint", MEND) from None


def _problem_of_header(header, steps):
    """How a header differs from one that a training of `steps` steps writes; "" if it does not."""
    known = REQUIRED | OPTIONAL
    if lacking := sorted(REQUIRED.keys() - header.keys()):
        return f"its header lacks {lacking[0]}"
    if unknown := sorted(header.keys() - known.keys()):
        return f"its header holds {shown(unknown[0], 40)}, which this version does not know"
    if wrong := [key for key, value in header.items() if type(value) not in known[key]]:
        return f"{wrong[0]} in its header has the wrong type"
    if not 1 <= header["step"] <= steps:
        return f"it is of step {shown(str(header['step']))}, but its config.json has {steps} steps"
    try:
        views, grid = unpacked_views(header["views"]), Grid.of_header(header["grid"])
        near, far = header["depth_range"]
        sound = (
            all(abs(x) < MOST_LENGTH for x in (*grid.origin, grid.voxel_size, near, far))
            and grid.voxel_size > 0 <= near < far
            and [type(n) for n in grid.dims] == [int, int, int]
            and min(grid.dims) > 0
            and grid.id_count <= MOST_IDS
            and 0 < header["initial_points"] <= MOST_IDS
            and 0 <= header.get("extended_from", 0) <= header["step"]
            and 0 <= header.get("progress", 0) <= 1
            and 0 <= header.get("seconds", 0) <= MOST_SECONDS
            and 0 <= header.get("passed", 0) <= MOST_SECONDS
            and set(header.get("left_out", [])) < {view.name for view in views}
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        sound = False
    return "" if sound else "its header holds numbers or names that no training writes"


def _problem_of_forms(stored, config):
    """How a checkpoint's arrays differ from those that the settings require; "" if they do not."""
    header, forms = stored.header, stored.forms
    ids = forms.get("points.ids")
    n = ids.shape[0] if ids and len(ids.shape) == 1 else 0
    refined = sum(0 < share < 1 for share in config.train.refine_at)
    most = min(math.prod(header["grid"]["dims"]), header["initial_points"] * 8**refined)
    if not 0 < n <= most:
        return f"points.ids is {ids or 'missing'}, expected 1 to {most} points"
    step, gains = None if header["finished"] else header["step"], 0
    if step is not None and config.train.exposure != "off":
        views = len(header["views"]) - len(header.get("left_out", []))
        # gains are stored until the training decides that it needs none
        if "exposed" in header or step < decided_at(header.get("extended_from", 0), views):
            gains = views
    averaged = header.get("averaged")
    table = stored_table(config, n, step, gains, averaged, has_specular="specular" in header)
    expected = {name: Form(tuple(shape), np.dtype(dtype)) for name, (shape, dtype) in table.items()}
    for name in sorted(expected.keys() | forms.keys()):
        form, wanted = forms.get(name), expected.get(name)
        if wanted is None:
            return f"holds {shown(name, 40)}, which does not belong there"
        if form != wanted:
            return f"{name} is {form or 'missing'}, expected {wanted}"
    return ""
