"""What readers share: images inside the scene's folder, and the split that is held out."""

import numpy as np
import pytest

from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.scene.readers.common import find_image, folder_images, hold_out, of_stem


def fail(text):
    return UserError(f"file: {text}")


def test_every_eighth_is_held_out():
    assert hold_out(range(18), "test") == [0, 8, 16]
    assert sorted(hold_out(range(18), "test") + hold_out(range(18), "train")) == list(range(18))


def test_the_first_ending_that_exists(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((2, 2)))
    assert find_image(tmp_path, "a", fail, ("", ".jpg", ".png")) == "a.png"
    assert find_image(tmp_path, "./b/../a.png", fail) == "a.png"
    with pytest.raises(UserError, match=r"no image at 'a', nor with \.jpg added"):
        find_image(tmp_path, "a", fail, ("", ".jpg"))


@pytest.mark.parametrize("given", ["../a.png", "/etc/hostname", "link.png", "a" * 999, "a\0b"])
def test_paths_that_cannot_be_used(tmp_path, given):
    (tmp_path / "scene").mkdir()
    write_png(tmp_path / "a.png", np.zeros((2, 2)))
    (tmp_path / "scene" / "link.png").symlink_to(tmp_path / "a.png")
    with pytest.raises(UserError, match="^file: ") as caught:
        find_image(tmp_path / "scene", given, fail)
    assert "\n" not in str(caught.value)


def test_images_of_a_folder_are_sorted_and_nothing_else_is_one(tmp_path):
    (tmp_path / "images" / "sub.png").mkdir(parents=True)
    for name in ("b.png", "a.PNG", "c.txt", "._b.png"):
        (tmp_path / "images" / name).write_bytes(b"")
    assert folder_images(tmp_path, "images") == ["images/a.PNG", "images/b.png"]
    assert of_stem(tmp_path, "images", "b") == "images/b.png"
    with pytest.raises(UserError, match="no mask c.png"):
        of_stem(tmp_path, "images", "c")
