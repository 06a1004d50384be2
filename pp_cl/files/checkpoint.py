"""Files of a run: written to a temporary name, synced, renamed; read without trust."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file

FORMAT = 1  # raised when the arrays change meaning


def save_checkpoint(
    path: Path | str, header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    """Write {name: numpy array} and a JSON header. The same content gives the same bytes: no times
    are stored.
    """
    meta = np.frombuffer(
        json.dumps({"format": FORMAT, **header}, sort_keys=True).encode(), np.uint8
    )
    with atomic_file(path) as file:
        np.savez(file, header=meta, **arrays)


def load_checkpoint(path: Path | str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, {name: numpy array}) of a checkpoint.

    Raises UserError naming the file when it is missing, truncated, corrupt, of another format, or
    holds NaN or Inf.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; train first")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop("header").tobytes())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
        raise UserError(
            f"{path}: corrupt checkpoint ({' '.join(str(error).split())[:100]}); delete it to train"
            " anew, or restore a copy"
        ) from None
    if header.get("format") != FORMAT:
        raise UserError(
            f"{path}: format {header.get('format')}, this version reads {FORMAT}; train anew"
        )
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(
                f"{path}: {name} holds NaN or Inf; delete it to train anew, or restore a copy"
            )
    return header, arrays


def fitting_array(
    arrays: dict[str, np.ndarray],
    name: str,
    shape: tuple[int, ...],
    file: Path,
    *,
    dtype: type = np.float32,
) -> np.ndarray:
    """The array called `name`, contiguous. Raises UserError naming the file and the array where it
    is missing or has another shape or dtype.
    """
    array = arrays.get(name)
    if array is None or array.shape != tuple(shape) or array.dtype != dtype:
        found = "missing" if array is None else f"{array.dtype} {array.shape}"
        raise UserError(
            f"{file}: {name} is {found}, expected {np.dtype(dtype)} {tuple(shape)}; "
            "its config.json may belong to another run"
        )
    return np.ascontiguousarray(array)
