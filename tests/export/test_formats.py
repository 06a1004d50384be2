"""Every format, from run to file."""

import shutil

import pytest

from pp_cl.export.formats import FORMATS, check_target, export
from pp_cl.scene.load import load_scene


@pytest.mark.parametrize("name", FORMATS)
def test_it_is_written_where_it_belongs_and_twice_alike(name, run, tmp_path):
    said, contents = [], []
    for _ in range(2):
        path = check_target(name, tmp_path, None)
        assert path.parent == tmp_path / "export"
        said.append(export(run, name, path))
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        contents.append([file.read_bytes() for file in files])
        shutil.rmtree(tmp_path / "export")
    assert said[0] == said[1] and contents[0] == contents[1] and contents[0]
    assert any(character.isdigit() for character in said[0])


def test_a_scene_can_be_given_its_folder(run, tmp_path):
    (tmp_path / "empty").mkdir()
    path = check_target("scene", tmp_path, tmp_path / "empty")
    assert export(run, "scene", path) == "12 train views, 2 test views"
    assert len(load_scene(path, ("test",)).splits["test"]) == 2
