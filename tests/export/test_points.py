"""Each point has the colour of the view in which it weighs most."""

import numpy as np
import pytest

from pp_cl.errors import UserError
from pp_cl.export.observe import observe
from pp_cl.export.points import coloured_points
from pp_cl.files.image import to_8bit


@pytest.fixture(scope="module")
def points(run):
    return coloured_points(run)


def test_colours_are_those_of_the_best_view(run, points):
    cameras = run.cameras("train")
    weights = np.stack([seen.point_weights() for seen in observe(run, cameras, "")])
    images = [to_8bit(run.render(camera).rgba()[..., :3]) for camera in cameras]
    positions = run.model.grid.positions(run.model.cloud.ids.get())
    assert points.rows.tolist() == np.flatnonzero(weights.max(0) > 0).tolist()
    for row, colour in list(zip(points.rows, points.colours, strict=True))[::40]:
        best = weights[:, row].argmax()
        camera = cameras[best]
        x, y, z = camera.pose[:, :3].T @ (positions[row] - camera.eye)
        column = min(max(int(camera.fx * x / z + camera.cx), 0), 29)
        line = min(max(int(camera.fy * y / z + camera.cy), 0), 29)
        assert colour.tolist() == images[best][line, column].tolist()
    assert points.weight == pytest.approx(weights.max(0)[points.rows])
    assert points.positions == pytest.approx(positions[points.rows], abs=1e-6)
    assert (points.opacity == run.model.cloud.opacity.get()[points.rows]).all()


def test_points_of_little_weight_are_left_out(run, points):
    some = coloured_points(run, min_weight=0.3)
    assert some.rows.tolist() == points.rows[points.weight > 0.3].tolist()
    assert 0 < len(some.rows) < len(points.rows)


def test_no_points_are_one_line(run):
    with pytest.raises(UserError, match="--min-weight 1000: no point weighs more"):
        coloured_points(run, min_weight=1000)
