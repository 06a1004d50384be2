"""Scenes as other programs, phones and people leave them: each trains, and what was done about it
is one line. All are of a ball. What names, files and lenses may be is tested with the readers.
"""

import json

import numpy as np
import pytest
from PIL import Image
from support.checkpoints import load_checkpoint
from support.runs import SETTINGS, set_words, spoken
from support.same_scene import held_out
from support.scenes import ball_image, ring_cameras

from pp_cl.files.image import ORIENTATION
from pp_cl.scene.readers.frame import GL_FROM_CV
from pp_cl.scene.views import View
from tools.convert_scene import convert

VIEWS = 14  # of which 12 are for training


def a_ball(folder, form):
    """The ball in a format, its masks in a folder of their own; images are broader than high."""
    cameras = [camera.crop(0, 3, 48, 42) for camera in ring_cameras(VIEWS, 48)]
    views = [View(f"{i}.png", camera, ball_image(camera)) for i, camera in enumerate(cameras)]
    convert(held_out(views), folder, form)
    return folder


def change_frames(folder, change):
    """Change the frames of a transforms.json: change(i, frame), frame by frame."""
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    for i, frame in enumerate(data["frames"]):
        change(i, frame)
    file.write_text(json.dumps(data))


def renamed(old, new):
    return lambda folder: (folder / old).rename(folder / new)


def turned(folder):
    """On their side, and EXIF says so, after the program had turned them."""
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    for file in sorted((folder / "images").iterdir()):
        image = Image.open(file).convert("RGB").transpose(Image.Transpose.ROTATE_90)
        file.unlink()
        image.save(file.with_suffix(".jpg"), exif=exif)


def two_cameras(folder):
    """Equal names in two folders, masks in the same tree, which no frame names."""

    def split(i, frame):
        for key, place in (("file_path", "images"), ("mask_path", "masks")):
            new = folder / place / "ab"[i % 2] / f"{i // 2}.png"
            new.parent.mkdir(exist_ok=True)
            (folder / frame[key]).rename(new)
            frame[key] = new.relative_to(folder).as_posix()
        del frame["mask_path"]

    change_frames(folder, split)
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    file.write_text(json.dumps({k: v for k, v in data.items() if not k.endswith("filenames")}))


# {report: (format, what is done to the folder, what is said)}
TRAINS = {
    "an image is gone": (
        "nerfstudio",
        lambda folder: (folder / "images/000003.png").unlink(),
        "1 of 12 views left out: no image (images/000003.png)",
    ),
    "transform.json": ("nerfstudio", renamed("transforms.json", "transform.json"), ""),
    "two cameras, equal names": ("nerfstudio", two_cameras, "masks are taken from"),
    "turned by EXIF": ("nerfstudio", turned, ""),
    "masks in a folder of another case": ("colmap", renamed("masks", "Masks"), ""),
    "reduced images alone": ("llff", renamed("images", "images_4"), ""),
}


def train(folder, out):
    sets = set_words(SETTINGS, train__iterations=3, train__previews=0)
    return spoken(["train", folder, "--out", out, *sets])


@pytest.mark.parametrize("report", TRAINS)
def test_it_trains_and_says_what_was_done(tmp_path, report):
    form, change, told = TRAINS[report]
    change(a_ball(tmp_path / "scene", form))
    status, lines = train(tmp_path / "scene", tmp_path / "run")
    said = [line for line in lines if line.startswith("pp-cl: ")]
    assert status == 0, lines
    assert len(said) == bool(told) and told in "".join(said), said
    header, _ = load_checkpoint(tmp_path / "run/checkpoint.npz")
    assert len(header.get("notes", [])) == len(said)
    assert len(header["views"]) == VIEWS - 2 - ("left out" in told)


@pytest.mark.parametrize("axes", ("opencv", "world-to-camera", "opencv world-to-camera"))
def test_axes_of_another_convention_are_named_and_can_be_stated(tmp_path, axes):
    """As the refusal says it is written."""
    folder = a_ball(tmp_path / "scene", "nerfstudio")

    def other(_, frame):
        pose = np.array(frame["transform_matrix"])
        pose = pose @ GL_FROM_CV if "opencv" in axes else pose
        frame["transform_matrix"] = (np.linalg.inv(pose) if "world" in axes else pose).tolist()

    change_frames(folder, other)
    status, lines = train(folder, tmp_path / "run")
    assert status == 2 and f'of the kind "{axes}"' in lines[-1] and not (tmp_path / "run").exists()
    edits = lines[-1].partition("write ")[2].partition(" into ")[0]
    (folder / "pp_cl.json").write_text(edits)
    status, lines = train(folder, tmp_path / "run")
    assert status == 0, lines
