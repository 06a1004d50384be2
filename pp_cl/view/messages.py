"""The websocket messages of the viewer: checks what a browser asks for, and packs the answers."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.untrusted import strict_json
from pp_cl.scene.camera import Camera
from pp_cl.scene.readers.common import fail_at
from pp_cl.scene.readers.frame import GL_FROM_CV, rigid

MOST_BYTES = 8192  # of a message: a camera in full precision takes a tenth of it
KINDS = ("frame", "snapshot")
SHOWN = ("colour", "alpha", "depth", "normals", "hits", "error", "photograph")
LEAST_SIDE, MOST_SIDE, MOST_PIXELS = 16, 4096, 2**23  # of a picture, as page.js
MOST_NUMBER = 2**53 - 1  # what a browser counts to exactly
# {name: (least, most)}; exposure in stops, kept as a share of the points
RANGES = {"early_stop": (0, 0.5), "kept": (0.001, 1), "exposure": (-6, 6)}
INTRINSICS = {"fl_x": (1, 1e6), "fl_y": (1, 1e6), "cx": (-1e5, 1e5), "cy": (-1e5, 1e5)}
MOST_DISTANCE = 1e15  # of an eye from the origin, world units: float32 holds its square


@dataclass(frozen=True)
class ViewRequest:
    """A picture that a tab asks for.

    number: grows from request to request. kind: of KINDS; a snapshot is lossless. show: of SHOWN.
    draft: at a quarter of the resolution. kept: share of the points, the most opaque ones, in
    (0, 1]. exposure: in stops.
    """

    number: int
    kind: str
    show: str
    camera: Camera
    draft: bool
    early_stop: float
    kept: float
    exposure: float


def packed(facts: dict[str, Any], image: bytes) -> bytes:
    """One message of facts, JSON-able, and an image file: the length of the facts, 4 bytes,
    little-endian; the facts as JSON; the file.
    """
    text = json.dumps(facts, allow_nan=False).encode()
    return len(text).to_bytes(4, "little") + text + image


def read_request(text: str) -> ViewRequest:
    """The request in a message. Raises UserError in one line for whatever is no such request."""
    try:
        message = strict_json(text)
    except (ValueError, RecursionError):
        raise UserError("the message is no JSON of finite numbers; reload the page") from None
    if not isinstance(message, dict):
        raise UserError("the message is no JSON object; reload the page")
    if type(message.get("draft")) is not bool:
        raise UserError("draft: must be true or false")
    return ViewRequest(
        number=_number(message, "number", (0, MOST_NUMBER), whole=True),
        kind=_word(message, "kind", KINDS),
        show=_word(message, "show", SHOWN),
        camera=_camera(message.get("camera")),
        draft=message["draft"],
        **{name: _number(message, name, limits) for name, limits in RANGES.items()},
    )


def _camera(facts):
    """The Camera of such facts. Raises UserError naming what is wrong."""
    if not isinstance(facts, dict):
        raise UserError("camera: is missing")
    sides = LEAST_SIDE, MOST_SIDE
    width, height = (_number(facts, key, sides, "camera.", whole=True) for key in "wh")
    if width * height > MOST_PIXELS:
        raise UserError(f"camera: {width}x{height} pixels are more than {MOST_PIXELS}")
    lens = [_number(facts, key, limits, "camera.") for key, limits in INTRINSICS.items()]
    return Camera(_pose(facts.get("transform_matrix")), *lens, width, height)


def _pose(rows):
    """(3, 4) float64 with OpenCV axes of a 4 x 4 matrix with OpenGL axes."""
    name = "camera.transform_matrix"
    rigid(rows, fail_at(name))  # refuses; what is rendered has the bits that were sent
    pose = np.array(rows, np.float64)[:3] @ GL_FROM_CV
    if np.abs(pose[:, 3]).max() > MOST_DISTANCE:
        raise UserError(f"{name}: the eye is more than {MOST_DISTANCE:g} from the origin")
    return pose


def _is_number(value):
    """Whether it is a finite number that float64 holds; true and false are none."""
    if type(value) is int:
        return abs(value) <= MOST_NUMBER
    return type(value) is float and math.isfinite(value)


def _number(message, key, limits, prefix="", whole=False):
    value, (least, most) = message.get(key), limits
    if not _is_number(value) or (whole and type(value) is not int) or not least <= value <= most:
        kind = "a whole number" if whole else "a number"
        raise UserError(f"{prefix}{key}: must be {kind} from {least:g} to {most:g}")
    return value


def _word(message, key, words):
    value = message.get(key)
    if not isinstance(value, str) or value not in words:
        raise UserError(f"{key}: must be one of {', '.join(words)}")
    return value
