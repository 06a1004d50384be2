import json
import shutil
from dataclasses import replace

import numpy as np
import plyfile
import pytest
import trimesh
from support.refused import refusing

from pp_cl.run import load
from pp_cl.scene.lens import LensDistortion
from pp_studio.export.formats import export_run
from pp_studio.export.length import metres_per_unit, set_length, surface_point

RADIUS = 0.8  # of the ball, in scene units


@pytest.fixture
def mine(run, run_folder, tmp_path):
    shutil.copytree(run_folder, tmp_path / "run")
    return load(tmp_path / "run", run.dev)


def text_of(photo, position):
    x, y, _ = photo.camera.project(position)
    return f"{photo.name}:{x:.3f},{y:.3f}"


def rims(photo, share):
    """Two points on the ball, left and right of its middle in an image, and their distance."""
    towards = photo.camera.eye / np.linalg.norm(photo.camera.eye)
    right = np.cross(photo.camera.pose[:, 1], towards)
    right /= np.linalg.norm(right)
    ends = [RADIUS * (np.sqrt(1 - share**2) * towards + s * share * right) for s in (-1, 1)]
    return ends, 2 * share * RADIUS


def test_pixels_tell_where_the_surface_is(mine):
    photo = mine.image_files("train")[2]
    ends, length = rims(photo, 0.6)
    points = [surface_point(mine, text_of(photo, end)) for end in ends]
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(length, rel=0.08)
    assert metres_per_unit(mine) == 1


def test_pixels_are_those_of_the_image_as_the_lens_has_it(mine, monkeypatch):
    lens, photo = LensDistortion(k1=-0.25, p1=0.01), mine.image_files("train")[2]
    camera, x, y = photo.camera, 20.4, 35.6
    straight = surface_point(mine, f"{photo.name}:{x},{y}")
    listed = [replace(each, lens=lens) for each in mine.image_files("train")]
    monkeypatch.setattr("pp_studio.export.length.scene_frames", lambda *_, **__: listed)
    x, y = lens.apply((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    bent = f"{photo.name}:{x * camera.fx + camera.cx:.3f},{y * camera.fy + camera.cy:.3f}"
    assert surface_point(mine, bent) == pytest.approx(straight, abs=1e-3)


@pytest.mark.parametrize("name", ["mesh", "splat", "ply"])
def test_exports_are_in_metres(mine, tmp_path, name):
    def spans(path):
        export_run(mine, name, path)
        if name == "mesh":
            return trimesh.load(path).extents
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        return [np.ptp(vertex[axis]) for axis in "xyz"]

    before = spans(tmp_path / "a.ply")
    photo = mine.image_files("train")[0]
    first, second = (text_of(photo, end) for end in rims(photo, 0.6)[0])
    apart = np.linalg.norm(surface_point(mine, first) - surface_point(mine, second))
    assert set_length(mine, first, second, 0.24) == pytest.approx(0.24 / apart)
    assert spans(tmp_path / "b.ply") == pytest.approx(np.multiply(before, 0.24 / apart), rel=1e-3)
    stored = json.loads((mine.folder.path / "length.json").read_text())
    assert stored["between"] == [first, second] and stored["metres"] == 0.24
    assert export_run(mine, name, tmp_path / "c.ply").endswith(", in metres")
    if name == "mesh":  # slicers take the numbers of an STL for millimetres
        assert export_run(mine, name, tmp_path / "c.stl").endswith(", in millimetres")
        wide = trimesh.load(tmp_path / "c.stl").extents
        assert wide == pytest.approx(1000 * np.asarray(spans(tmp_path / "d.ply")), rel=1e-3)


def test_what_tells_no_length_is_refused(mine):
    photo = mine.image_files("train")[0]
    good = text_of(photo, mine.model.positions().mean(0))
    with refusing("PHOTO:X,Y"):
        surface_point(mine, "a.jpg")
    with refusing(f"no training image of that name; did you mean {photo.name}?"):
        surface_point(mine, f"{photo.name}x:1,2")
    with refusing("60x60"):
        surface_point(mine, f"{photo.name}:60,2")
    with refusing("no object"):
        surface_point(mine, f"{photo.name}:0,0")
    with refusing("the same place"):
        set_length(mine, good, good, 1.0)
    file = mine.folder.path / "length.json"
    assert not file.exists()
    for broken in ('{"metres_per_unit": -1}', "["):
        file.write_text(broken)
        with refusing(file, "--length"):
            metres_per_unit(mine)
