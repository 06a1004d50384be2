"""Images that a large scene's training keeps in its run: a resume reads no photograph again, and
ends in the same bytes.
"""

import json
import os

import numpy as np
import pytest
from PIL import Image
from support.runs import arguments, checkpoint, train_and_interrupt
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.errors import UserError
from pp_cl.files.atomic import own
from pp_cl.scene.kept import KeptViews
from pp_cl.scene.load import load_scene


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Eight photographs with distortion that are halved while they are read."""
    monkeypatch.setattr("pp_cl.scene.image_file.KEPT_BYTES", 8 * 4 * 50 * 50)
    folder = write_ball_scene(tmp_path / "ball", size=98)
    file = tmp_path / "ball/transforms_train.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"k1": 0.1}))
    return folder


@pytest.fixture
def looked_at(monkeypatch):
    """The photographs that were decoded, by name."""
    from pp_cl.scene import load

    names, read = [], load.read_rgba

    def looked(file, size):
        names.append(file.name)
        return read(file, size)

    monkeypatch.setattr(load, "read_rgba", looked)
    return names


def test_what_was_read_comes_back_and_what_changed_is_read_again(
    dev, scene, tmp_path, looked_at, recwarn
):
    folder = tmp_path / "views"
    own(tmp_path)

    def views(**how):
        kept = KeptViews(folder)
        found = load_scene(scene, downscale=4, dev=dev, kept=kept, **how).splits["train"]
        kept.write()
        return found, kept

    first, _ = views()
    assert len(looked_at) == len(first) == len(list(folder.iterdir())) == 8
    looked_at.clear()
    again, _ = views()
    assert not looked_at
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        assert (one.digest, one.camera.fx) == (other.digest, other.camera.fx)

    photograph = f"{scene}/{first[3].name}"
    pixels = np.array(Image.open(photograph))
    pixels[20:40] //= 2
    Image.fromarray(pixels).save(photograph)
    sorted(folder.iterdir())[0].write_bytes(b"broken")
    sorted(folder.iterdir())[1].write_bytes(b"")
    changed, kept = views()
    assert 2 <= len(set(looked_at)) <= 3 and first[3].name.rpartition("/")[2] in looked_at
    assert changed[3].digest != first[3].digest
    looked_at.clear()
    views(most=3)
    assert not looked_at, "what is reduced alike is the same image"

    (folder / "mine.txt").write_text("mine")
    kept.remove()
    left = [file.name for file in folder.iterdir() if file.suffix != ".png"]
    assert left == ["mine.txt"] and not recwarn.list


def test_a_resume_reads_nothing_again_and_a_finished_run_keeps_nothing(
    scene, tmp_path, looked_at, monkeypatch
):
    words = {"downscale": 4, "train__iterations": 8, "train__checkpoint_every": 3}
    assert main(arguments(scene, tmp_path / "whole", **words)) == 0
    assert not (tmp_path / "whole/views").exists()
    train_and_interrupt(scene, tmp_path / "run", 5, monkeypatch, **words)
    assert len(list((tmp_path / "run/views").iterdir())) == 8
    looked_at.clear()
    assert main(arguments(scene, tmp_path / "run", **words)) == 0
    assert not looked_at and not (tmp_path / "run/views").exists()
    assert checkpoint(tmp_path / "run") == checkpoint(tmp_path / "whole")


def test_a_training_goes_on_where_nothing_can_be_kept(scene, tmp_path, monkeypatch, capsys):
    def full(file):
        raise UserError(f"{file}: cannot be written ({os.strerror(28)})")

    monkeypatch.setattr("pp_cl.scene.kept.atomic_file", full)
    assert main(arguments(scene, tmp_path / "run", downscale=4, train__iterations=2)) == 0
    assert capsys.readouterr().err.count("a resume reads the photographs again") == 1
