"""True size: how many metres a unit of a run's scene is, from one known length."""

import json
import re

import numpy as np
from scipy.optimize import root

from pp_cl import Run
from pp_cl.errors import UserError, quoted, shown, suggestion
from pp_cl.files import read_json_text, write_json
from pp_cl.scene import scene_frames

FILE = "length.json"  # in the folder of a run
MOST_BYTES = 2**16
SMALLEST, LARGEST = 1e-9, 1e9  # metres a unit
OPAQUE = 0.5  # least alpha of a pixel that shows the object


def metres_per_unit(run: Run) -> float:
    """The scale that set_length() stored, else 1. Raises UserError for a broken file."""
    path = run.folder.path / FILE
    if not path.exists():
        return 1.0
    try:
        metres = json.loads(read_json_text(path, MOST_BYTES))["metres_per_unit"]
        if type(metres) not in (int, float) or not SMALLEST <= metres <= LARGEST:
            raise ValueError(f"metres_per_unit is {quoted(metres, 40)}")
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise UserError(
            f"{path}: is damaged ({shown(str(error))}); give --length again, or remove it"
        ) from None
    return float(metres)


def set_length(run: Run, first: str, second: str, metres: float) -> float:
    """Store in the run's folder that two points of the object are `metres` apart, and return the
    metres of a scene unit; from then on all exports of coordinates are in metres. first, second:
    PHOTO:X,Y, as for `surface_point`. Raises UserError if both points are at one place.
    """
    apart = float(np.linalg.norm(surface_point(run, first) - surface_point(run, second)))
    if apart < run.model.grid.voxel_size:
        raise UserError(f"--length {first} {second}: show the same place; name two far apart")
    unit = float(metres) / apart
    if not SMALLEST <= unit <= LARGEST:
        raise UserError(f"--length {metres:g}: a unit of the scene would be {unit:g} m")
    facts = {"metres_per_unit": unit, "between": [first, second], "metres": float(metres)}
    write_json(run.folder.path / FILE, facts)
    return unit


def _straight(run, image_file, x, y):
    """The pixel without distortion; (x, y) unchanged if the scene, which stores it, is gone."""
    try:
        listed = scene_frames(run.config.scene.path, edited=False)
    except UserError:
        return x, y
    lens = next((frame.lens for frame in listed if frame.name == image_file.name), None)
    if not lens:
        return x, y
    camera = image_file.camera
    there = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    solution = root(lambda place: np.subtract(lens.apply(*place), there), there)
    if not solution.success:  # NaN lies outside every image
        return np.nan, np.nan
    return solution.x[0] * camera.fx + camera.cx, solution.x[1] * camera.fy + camera.cy


def surface_point(run: Run, text: str) -> np.ndarray:
    """(3,) world position of the object at a pixel of a training image. text: PHOTO:X,Y, the
    image's path in the scene or the end of it, and pixels from its upper left corner. Raises
    UserError if there is no such image or pixel, or it does not show the object.
    """
    parsed = re.fullmatch(r"(.+):([0-9.]+),([0-9.]+)", text)
    try:
        name, x, y = parsed[1], float(parsed[2]), float(parsed[3])  # type: ignore[index]
    except (TypeError, ValueError):
        raise UserError(
            f"--length {shown(text)}: write PHOTO:X,Y, for example a.jpg:812,430"
        ) from None
    refused, image_files = f"--length {shown(text)}: ", run.image_files("train")
    matches = [file for file in image_files if file.name == name or file.name.endswith(f"/{name}")]
    if len(matches) > 1:
        raise UserError(f"{refused}{name} is in several folders; write more of its path")
    if not matches:
        names = [file.name for file in image_files]
        near = suggestion(name, names).strip() or f"name one such as {names[0]}"
        raise UserError(f"{refused}no training image of that name; {near}")
    stored = matches[0].camera
    if not (x < stored.width and y < stored.height):
        raise UserError(f"{refused}the image has {stored.width}x{stored.height} pixels")
    x, y = _straight(run, matches[0], x, y)
    if not (0 <= x < stored.width and 0 <= y < stored.height):
        raise UserError(f"{refused}lies beyond what is left of the image")
    camera = stored.downscaled(run.config.scene.downscale)
    rendered = run.render(camera)
    column = min(int(x * camera.fx / stored.fx), camera.width - 1)
    row = min(int(y * camera.fy / stored.fy), camera.height - 1)
    if not rendered.alpha[row, column] > OPAQUE:
        raise UserError(f"{refused}the model shows no object there")
    along = np.array([(x - stored.cx) / stored.fx, (y - stored.cy) / stored.fy, 1.0])
    return stored.eye + rendered.median_depth[row, column] * stored.pose[:, :3] @ along
