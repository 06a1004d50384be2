"""Reads the checkpoint of a run and checks its arrays against the run's settings before anything
uses them.
"""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from pp_cl.config import Config
from pp_cl.errors import UserError, quoted, shown
from pp_cl.files.checkpoint import MEND, Checkpoint, Form, opened_checkpoint
from pp_cl.files.run_folder import RunFolder
from pp_cl.network.layers import parameter_table, unet_layers
from pp_cl.raster.points import MOST_OFFSET, SH_DEGREES, sh_blocks
from pp_cl.scene.grid import MOST_VERTICES
from pp_cl.scene.identity import DIGITS, kept_views
from pp_cl.training.exposure import decided_at
from pp_cl.training.schedule import bound_to_end, ema_start
from pp_cl.training.state import PointState

LEAST_LENGTH, MOST_LENGTH = 1e-30, 1e30  # world units; float32 would hold no products of others
LEAST_SHARE = 1e-6  # of far, between it and near: float32 would hold them as one
MOST_TEXT = 1000
DIGEST = re.compile(f"[0-9a-f]{{{DIGITS}}}")
OPTIONAL = {"format", "extended_from", "exposed", "left_out", "notes"}  # keys of a header
GRID = ("origin", "edge", "dims")


class StoredRun:
    """The opened checkpoint of a run with these settings. header: see _header_rules(); forms:
    {name: Form}, exactly those of stored_forms().

    Raises UserError naming the file, and what in it is not as it must be.
    """

    def __init__(self, checkpoint: Checkpoint, config: Config) -> None:
        self.header, self.forms = checkpoint.header, checkpoint.forms
        self._checkpoint = checkpoint
        self._check_header(config)
        self._check_forms(config)

    def array(self, name: str) -> np.ndarray:
        """One of its arrays. Raises UserError naming file and array where it cannot be read, or
        holds what it cannot hold.
        """
        array = self._checkpoint.array(name)
        rule = _array_rule(name, self.header)
        if rule and not rule[0](array):
            self._refuse(f"{name} holds other than {rule[1]}")
        return array

    def arrays(self) -> dict[str, np.ndarray]:
        """{name: array} of all. Raises UserError as array() does."""
        return {name: self.array(name) for name in self.forms}

    def _refuse(self, what, mend=MEND):
        raise UserError(f"{self._checkpoint.path}: {what}; {mend}")

    def _check_header(self, config):
        header, rules = self.header, _header_rules(config)
        missing = [key for key in rules if key not in header]
        if missing:
            self._refuse(f"its header lacks {', '.join(missing)}")
        unknown = sorted(header.keys() - rules.keys() - OPTIONAL)
        if unknown:
            self._refuse(f"its header holds {shown(unknown[0], 40)}, which this version knows not")
        if "extended_from" in header:
            rules["extended_from"] = (
                lambda x: type(x) is int and 1 <= x <= header["step"],  # which is checked before
                "a step that is done",
            )
        if "exposed" in header:
            rules["exposed"] = (lambda x: x is True, "true")
        if "notes" in header:
            rules["notes"] = (_are_texts, "lines of text")
        if "left_out" in header:
            rules["left_out"] = (
                lambda x: _are_some(x, kept_views(header["views"])),  # which is checked before
                "names of some of its views",
            )
        for key, (is_right, expected) in rules.items():
            if not is_right(header[key]):
                self._refuse(f"{key} in its header is {quoted(header[key])}, expected {expected}")
        if header["step"] == config.train.iterations and not header["finished"]:
            self._refuse(
                f"it is not finished at step {header['step']}, the last in its config.json"
            )

    def _check_forms(self, config):
        """Compare names, shapes and dtypes with what the settings call for."""
        ids = self.forms.get("points.ids")
        n = ids.shape[0] if ids and len(ids.shape) == 1 else 0
        header, mend = self.header, "its config.json may belong to another run"
        refined = sum(0 < share < 1 for share in config.train.refine_at)
        most = min(math.prod(header["grid"]["dims"]), header["initial_points"] * 8**refined)
        if not 0 < n <= most:
            self._refuse(f"points.ids is {ids or 'missing'}, expected 1 to {most} points")
        half = self.forms.get("points.sh0", ids).dtype == np.float16
        ends = header["finished"] and bound_to_end(config.network, config.raster, config.train)
        is_bare = ends or (header["finished"] and "state.last_step" not in self.forms)
        step = None if is_bare else header["step"]
        gains = 0 if step is None else _views_with_gains(header, config)
        expected = stored_forms(config, n, step, half and header["finished"], gains)
        for name in sorted(expected.keys() | self.forms.keys()):
            found, wanted = self.forms.get(name), expected.get(name)
            if wanted is None:
                self._refuse(f"holds {shown(name, 40)}, which does not belong there", mend)
            if found != wanted:
                self._refuse(f"{name} is {found or 'missing'}, expected {wanted}", mend)


@contextmanager
def opened_run(folder: RunFolder, config: Config) -> Iterator[StoredRun]:
    """The checkpoint in the folder of a run with these settings, until the block ends. Raises
    UserError as opened_checkpoint and StoredRun do.
    """
    with opened_checkpoint(folder.checkpoint) as checkpoint:
        yield StoredRun(checkpoint, config)


def load_run_state(
    folder: RunFolder, config: Config
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, arrays) of the checkpoint in the folder of a run with these settings. Raises
    UserError as opened_run does.
    """
    with opened_run(folder, config) as stored:
        return stored.header, stored.arrays()


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
    blocks, settings = sh_blocks(config.points.sh_degree), config.train
    points = PointState.table(n)
    table = {f"moment.{kind}.{name}": row for name, row in network.items() for kind in "mv"}
    if settings.ema and step >= ema_start(settings.iterations):
        points |= {f"a.{name}": row for name, row in PointState.ema_table(n, blocks).items()}
        table |= {f"average.{name}": row for name, row in network.items()}
    return table | {f"state.{name}": row for name, row in points.items()}


# --------------------------------------------------------------------------------------------------

Rule = tuple[Callable[[Any], bool], str]  # whether a value is right, and what it should be


def _header_rules(config: Config) -> dict[str, Rule]:
    """{key of the header: Rule}, beside those of OPTIONAL."""
    steps = config.train.iterations
    return {
        "scene": (lambda x: type(x) is str and 0 < len(x) <= MOST_TEXT, "a text"),
        "views": (_are_views, "names and cameras of training views"),
        "pixels": (_are_digests, "the digests of photographs"),
        "step": (_whole_in(1, steps), f"one of the {steps} steps of its config.json"),
        "finished": (lambda x: type(x) is bool, "true or false"),
        "initial_points": (_whole_in(1, MOST_VERTICES), "a number of points"),
        "grid": (_is_grid, "three numbers, a length and three numbers of vertices"),
        "depth_range": (_is_depth_range, "near and far"),
    }


def _are_views(views):
    try:
        return bool(kept_views(views))
    except ValueError:
        return False


def _are_some(names, views):
    known = {view.name for view in views}
    return (
        isinstance(names, list)
        and all(type(name) is str for name in names)
        and 0 < len(set(names) & known) == len(names) < len(known)
    )


def _are_texts(lines):
    return isinstance(lines, list) and all(
        type(line) is str and len(line) <= MOST_TEXT for line in lines
    )


def _are_digests(pixels):
    """Whether it is what identity() gives."""
    return pixels is None or (
        isinstance(pixels, dict)
        and len(pixels) > 0
        and all(type(x) is str and DIGEST.fullmatch(x) for x in pixels.values())
    )


def _whole_in(least, most):
    return lambda x: type(x) is int and least <= x <= most


def _are_numbers(values, count):
    return (
        isinstance(values, list)
        and len(values) == count
        and all(type(x) in (int, float) and abs(x) < MOST_LENGTH for x in values)
    )


def _is_grid(grid):
    if not isinstance(grid, dict) or sorted(grid) != sorted(GRID):
        return False
    origin, edge, dims = (grid[key] for key in GRID)
    return (
        _are_numbers(origin, 3)
        and _are_numbers([edge], 1)
        and edge > LEAST_LENGTH
        and _are_numbers(dims, 3)
        and all(type(n) is int and n > 0 for n in dims)
        and math.prod(dims) <= MOST_VERTICES
    )


def _is_depth_range(values):
    if not _are_numbers(values, 2):
        return False
    near, far = values
    return near >= 0 and far > LEAST_LENGTH and far - near > LEAST_SHARE * far


def _array_rule(name: str, header: dict[str, Any]) -> Rule | None:
    """What the numbers of an array must be beside finite."""
    if name == "points.ids":
        vertices = math.prod(header["grid"]["dims"])
        return (
            lambda a: bool((a[1:] > a[:-1]).all() and a[-1] < vertices),
            "vertices of its grid in ascending order",
        )
    if name in ("points.offset", "state.a.offset"):
        return (
            lambda a: np.abs(a).max() <= MOST_OFFSET,
            f"offsets of up to {MOST_OFFSET}",
        )
    if name in ("points.opacity", "state.a.opacity"):
        return lambda a: a.min() >= 0 and a.max() <= 1, "opacities from 0 to 1"
    if name == "state.last_step":
        return lambda a: a.max() <= header["step"], "steps that are done"
    if name == "exposure":
        return lambda a: a[..., 1:3].min() >= 0 and a[..., 3].min() > 0, "gains above 0"
    if name in ("state.max_weight", "state.times_seen") or name.startswith(
        ("state.v.", "moment.v.")
    ):
        return lambda a: a.min() >= 0, "numbers from 0 on"
    return None
