"""A user's decisions about a scene (the object's box, views to leave out, camera axes), in a small
file in its folder, which readers of every format obey.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from pp_cl.errors import quoted
from pp_cl.files.atomic import told, write_json
from pp_cl.scene.conventions import WORDS
from pp_cl.scene.readers.common import checked_box, fail_at, read_json

EDITS = "pp_cl.json"


class Edits(NamedTuple):
    """box: (2, 3) lower and upper corner in world units. dropped: names of images, as the scene
    lists them. axes: how to read its cameras: one or more of conventions.WORDS.
    """

    box: np.ndarray | None = None
    dropped: frozenset[str] = frozenset()
    axes: str | None = None


def read_edits(folder: Path) -> Edits:
    """The edits of a scene. Raises UserError naming the file and the wrong key."""
    file = folder / EDITS
    if not file.exists():
        return Edits()
    stored = read_json(file)
    if not isinstance(stored, dict) or not stored.keys() <= set(Edits._fields):
        keys = " and ".join(f'"{key}"' for key in Edits._fields)
        raise fail_at(file)(f"must be a JSON object with no keys other than {keys}; correct it")
    axes = stored.get("axes")
    if axes is not None and not (isinstance(axes, str) and {*axes.split()} <= {*WORDS} and axes):
        what = f"is {quoted(axes, 40)}; must be one or more of the words {', '.join(WORDS)}"
        raise fail_at(file, "axes")(what)
    dropped = stored.get("dropped", [])
    if not isinstance(dropped, list) or not all(type(name) is str for name in dropped):
        raise fail_at(file, "dropped")("must be a list of image names; correct it")
    corners = stored.get("box")
    box = None if corners is None else checked_box(corners, fail_at(file, "box"))
    return Edits(box, frozenset(dropped), axes)


def write_edits(folder: Path, edits: Edits) -> None:
    """Write the edits into a scene's folder, or remove the file if there are none. Raises
    UserError.
    """
    file, box = folder / EDITS, None
    if edits.box is not None:
        box = checked_box(np.array(edits.box).tolist(), fail_at(file, "box")).tolist()
    facts = {"box": box, "dropped": sorted(edits.dropped), "axes": edits.axes}
    facts = {key: value for key, value in facts.items() if value}
    if facts:
        write_json(file, facts)
        return
    with told(file):
        file.unlink(missing_ok=True)
