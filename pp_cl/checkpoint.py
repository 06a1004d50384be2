"""Reads the checkpoint of a run and compares it with the run's settings before anything uses it."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from pp_cl.engine.grid import MOST_IDS, Grid
from pp_cl.engine.network.layers import parameter_table, unet_layers
from pp_cl.engine.raster.points import SH_DEGREES
from pp_cl.engine.training.exposure import decided_at
from pp_cl.engine.training.schedule import ema_start
from pp_cl.engine.training.state import PointState
from pp_cl.errors import UserError, shown
from pp_cl.files.checkpoint import MEND, Checkpoint, Form, opened_checkpoint
from pp_cl.files.run_folder import RunFolder
from pp_cl.scene.identity import kept_views
from pp_cl.settings import Config

MOST_LENGTH = 1e30  # world units; float32 would hold no products of larger ones
# {key of the header: its type as JSON has it}; those that it may lack
NEEDED: dict[str, Any] = {"views": list, "step": int, "finished": bool}
NEEDED |= {"initial_points": int, "grid": dict, "depth_range": list, "pixels": dict | None}
OPTIONAL = {"format": int, "extended_from": int, "exposed": bool, "left_out": list, "notes": list}
OTHER_RUN = "its config.json may belong to another run"


@contextmanager
def opened_run(folder: RunFolder, config: Config) -> Iterator[Checkpoint]:
    """The checkpoint in the folder of a run with these settings, until the block ends. Its header
    has the keys of NEEDED, and its forms are exactly those of stored_forms().

    Raises UserError as opened_checkpoint does, and naming what in the file is not of this run.
    """
    with opened_checkpoint(folder.checkpoint) as stored:
        problem, mend = _problem_of_header(stored.header, config.train.iterations), MEND
        if not problem:
            problem, mend = _problem_of_forms(stored, config), OTHER_RUN
        if not problem and not _are_ids(stored.array("points.ids"), stored.header["grid"]):
            problem, mend = "points.ids are no vertices of its grid in ascending order", MEND
        if problem:
            raise UserError(f"{folder.checkpoint}: {problem}; {mend}")
        yield stored


def load_run_state(
    folder: RunFolder, config: Config
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, arrays) of the checkpoint in the folder of a run with these settings. Raises
    UserError as opened_run does.
    """
    with opened_run(folder, config) as stored:
        return stored.header, stored.arrays()


def _problem_of_header(header, steps):
    """What in a header is not as a training of so many steps writes it; "" where all is."""
    for key, kind in (NEEDED | OPTIONAL).items():
        if key in NEEDED and key not in header:
            return f"its header lacks {key}"
        if key not in header:
            continue
        is_flag = isinstance(header[key], bool)  # which Python takes for a whole number
        if not isinstance(header[key], kind) or is_flag != (kind is bool):
            return f"{key} in its header is of another kind"
    if unknown := sorted(header.keys() - NEEDED.keys() - OPTIONAL.keys()):
        return f"its header holds {shown(unknown[0], 40)}, which this version does not know"
    if not 1 <= header["step"] <= steps:
        return f"it is of step {shown(str(header['step']))}, of {steps} in its config.json"
    try:
        views, grid = kept_views(header["views"]), Grid.of_header(header["grid"])
        near, far = header["depth_range"]
        lengths = [*grid.origin, grid.edge, near, far]
        names, left_out = {view.name for view in views}, set(header.get("left_out", []))
        sound = (
            all(abs(length) < MOST_LENGTH for length in lengths)
            and grid.edge > 0 <= near < far
            and [type(n) for n in grid.dims] == [int, int, int]
            and min(grid.dims) > 0
            and grid.id_count <= MOST_IDS
            and 0 < header["initial_points"] <= MOST_IDS
            and 0 <= header.get("extended_from", 0) <= header["step"]
            and left_out < names
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        sound = False
    return "" if sound else "its header holds numbers or names that no training writes"


def _problem_of_forms(stored, config):
    """How the names, shapes and dtypes of a checkpoint differ from what the settings call for; ""
    where they do not.
    """
    header, forms = stored.header, stored.forms
    ids = forms.get("points.ids")
    n = ids.shape[0] if ids and len(ids.shape) == 1 else 0
    refined = sum(0 < share < 1 for share in config.train.refine_at)
    most = min(math.prod(header["grid"]["dims"]), header["initial_points"] * 8**refined)
    if not 0 < n <= most:
        return f"points.ids is {ids or 'missing'}, expected 1 to {most} points"
    half = forms.get("points.sh0", ids).dtype == np.float16
    step = None if header["finished"] else header["step"]
    gains = 0 if step is None else _views_with_gains(header, config)
    expected = stored_forms(config, n, step, half and header["finished"], gains)
    for name in sorted(expected.keys() | forms.keys()):
        found, wanted = forms.get(name), expected.get(name)
        if wanted is None:
            return f"holds {shown(name, 40)}, which does not belong there"
        if found != wanted:
            return f"{name} is {found or 'missing'}, expected {wanted}"
    return ""


def _are_ids(ids, grid):
    """Whether they are what kernels may index a grid with."""
    is_ascending = bool((ids[1:] > ids[:-1]).all())
    return is_ascending and bool((Grid.of_header(grid).coordinates(ids) < grid["dims"]).all())


def _views_with_gains(header, config):
    """How many views have gains in the checkpoint of an unfinished training, which are kept until
    it is decided that it needs none.
    """
    views = len(header["views"]) - len(header.get("left_out", []))
    begun = header.get("extended_from", 0)
    is_kept = "exposed" in header or header["step"] < decided_at(begun, views)
    return views if is_kept and config.train.exposure != "off" else 0


def stored_forms(
    config: Config, n: int, step: int | None, half: bool = False, gains: int = 0
) -> dict[str, Form]:
    """{name: Form} of the arrays that a checkpoint holds after `step` steps, None: of a finished
    training, with n points left. half: with coefficients of 16 bits, as a compressed run has them.
    gains: the views that have them.
    """
    degree, colours = config.points.sh_degree, np.float16 if half else np.float32
    settings = config.network
    layers = unet_layers(settings.widths, blocks=settings.blocks)
    network = parameter_table(layers)
    table: dict[str, Any] = {"points.ids": ((n,), np.uint32), "points.opacity": ((n,), np.float32)}
    table["points.offset"] = (n, 4), np.float32
    table |= {f"points.sh{d}": ((n, 2 * d + 1, 16), colours) for d in SH_DEGREES[: degree + 1]}
    table |= {f"net.{name}": row for name, row in network.items()}
    if step is not None:
        table |= _training_state(config, n, step, network)
    if gains:
        table["exposure"] = ((gains, 3, 4), np.float32)
    return {name: Form(tuple(shape), np.dtype(dtype)) for name, (shape, dtype) in table.items()}


def _training_state(config, n, step, network):
    """The table of what is there until the last step is done."""
    settings = config.train
    points = PointState.table(n)
    table = {f"moment.{kind}.{name}": row for name, row in network.items() for kind in "mv"}
    if settings.ema and step >= ema_start(settings.iterations):
        points |= {f"a.{name}": row for name, row in PointState.ema_table(n).items()}
        table |= {f"average.{name}": row for name, row in network.items()}
    return table | {f"state.{name}": row for name, row in points.items()}
