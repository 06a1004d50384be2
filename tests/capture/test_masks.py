"""Masks of photographs with known cameras, from each of their sources."""

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from pp_cl.errors import UserError
from pp_cl.files.image import read_gray
from pp_cl.scene.demo import OBJECT_BOX, demo_frames, distances, render
from pp_cl.scene.grid import Grid, smallest_edge
from pp_cl.scene.views import Photograph, evenly

pytest.importorskip("cv2")

from pp_cl.capture import cut
from pp_cl.capture.masks import mask_file, program_words, write_masks

SIZE, VIEWS = 128, 12
WIDER = 1.4  # angle of view, so that there is background on all sides
BEHIND = 5.0  # radius of the room


class Capture:
    """The demo's object before a wall of noise: photographs in a folder, true masks, sparse
    points.
    """

    def __init__(self, dev, folder, spoil=None):
        rng = np.random.default_rng(3)
        self.folder, self.box = folder, np.array(OBJECT_BOX) * 1.06
        (folder / "images").mkdir(parents=True)
        self.truth, self.photographs = [], []
        for i, frame in enumerate(evenly(demo_frames("train", SIZE), VIEWS)):
            camera = frame.camera.with_angle(WIDER * 2 * np.arctan(SIZE / 2 / frame.camera.fx))
            rgba = render(dev, camera) / 255
            wall = gaussian_filter(rng.uniform(0, 1, (SIZE, SIZE, 3)), (1.5, 1.5, 0))
            wall = (wall - wall.mean()) * 1.2 + [0.25, 0.55, 0.3]
            photograph = rgba[..., :3] * rgba[..., 3:] + wall * (1 - rgba[..., 3:])
            if i == 0 and spoil:
                spoil(photograph)
            name = f"images/{i:02d}.png"
            Image.fromarray(np.uint8(255 * np.clip(photograph, 0, 1))).save(folder / name)
            self.truth.append(rgba[..., 3] > 0.5)
            self.photographs.append(Photograph(name, camera))
        grid = Grid.centred_in(self.box, smallest_edge(self.box, 40**3))
        far = np.abs(distances(dev, grid).ravel())
        surface = grid.positions(np.flatnonzero(far < 0.2 * grid.edge))
        surface = surface[rng.permutation(len(surface))[:300]]
        wall = rng.normal(size=(600, 3))
        wall *= BEHIND / np.linalg.norm(wall, axis=1, keepdims=True)
        self.points, self.seen = np.concatenate([surface, wall]), []
        for one, mask in zip(self.photographs, self.truth, strict=True):
            window = cut.Window("", np.zeros((SIZE, SIZE, 3)), one.camera, one.distortion, ())
            found, rows, columns = window.inside(self.points)
            is_shown = mask[rows, columns] == (found < len(surface))
            self.seen.append(found[is_shown & (rng.uniform(size=len(found)) < 0.5)])

    def write(self, **options):
        """What write_masks says."""
        masks = self.folder / "masks"
        return write_masks(
            self.folder, masks, self.photographs, self.box, self.points, self.seen, **options
        )

    def agreement(self):
        """(V,) intersection over union of each mask with the true one."""
        found = [read_gray(self.file(i)) > 127 for i in range(VIEWS)]
        pairs = zip(found, self.truth, strict=True)
        return np.array([(a & b).sum() / (a | b).sum() for a, b in pairs])

    def file(self, number):
        """The mask of a photograph."""
        return mask_file(self.folder / "masks", self.photographs[number].name)


@pytest.fixture
def capture(dev, tmp_path):
    """A Capture whose masks are not known."""
    return Capture(dev, tmp_path / "scene")


def given_masks(capture, folder):
    """A folder of the true masks, named like the photographs."""
    folder.mkdir()
    for one, mask in zip(capture.photographs, capture.truth, strict=True):
        Image.fromarray(np.uint8(255 * mask)).save(folder / Path(one.name).name)
    return folder


def test_the_object_is_cut_out_of_any_background(capture):
    """From sparse points alone; at 128 pixels a ring of the object is two pixels wide."""
    line = capture.write()
    found = capture.agreement()
    print(found)
    assert f"{VIEWS} cut out" in line
    assert found.mean() > 0.8
    assert found.min() > 0.7
    assert len(np.unique(read_gray(capture.file(0)))) > 4, "no soft border"


def test_the_other_views_carve_what_one_takes_for_the_object(dev, tmp_path, monkeypatch):
    """A bystander of the object's colours in one photograph, beside the object."""

    def bystander(photograph):
        photograph[20:50, 64:110] = photograph[60:64, 60:64].mean((0, 1))

    capture = Capture(dev, tmp_path / "scene", bystander)
    capture.write()
    voted = capture.agreement()[0]
    for number in range(VIEWS):
        capture.file(number).unlink()
    monkeypatch.setattr(cut, "ROUNDS", 0)
    capture.write()
    print(voted, capture.agreement()[0])
    assert voted > capture.agreement()[0] + 0.1


def test_what_is_there_is_kept_and_helps(capture):
    """A second start makes what is missing, the same but for what the kept masks change."""
    capture.write()
    first, mask = capture.agreement(), capture.file(3).read_bytes()
    capture.file(5).unlink()
    line = capture.write()
    assert f"{VIEWS - 1} kept" in line
    assert "1 cut out" in line
    assert capture.file(3).read_bytes() == mask
    assert capture.agreement()[5] > first[5] - 0.05


def test_given_masks_come_first(capture, tmp_path):
    """And they are copied as they are."""
    line = capture.write(given=given_masks(capture, tmp_path / "given"))
    assert f"{VIEWS} given" in line
    assert (capture.agreement() == 1).all()


def test_masks_that_contradict_the_others_are_named(capture, tmp_path):
    """One is shifted by a third of the image."""
    folder = given_masks(capture, tmp_path / "given")
    wrong = np.roll(capture.truth[4], SIZE // 3, axis=1)
    Image.fromarray(np.uint8(255 * wrong)).save(folder / "04.png")
    assert "04.png" in capture.write(given=folder)


@pytest.mark.parametrize("broken", ["missing", "truncated", "another size"])
def test_a_given_mask_that_is_no_use_is_named(capture, tmp_path, broken):
    """Before anything is cut."""
    folder = given_masks(capture, tmp_path / "given")
    if broken == "missing":
        (folder / "07.png").unlink()
    elif broken == "truncated":
        (folder / "07.png").write_bytes((folder / "07.png").read_bytes()[:60])
    else:
        Image.new("L", (8, 8)).save(folder / "07.png")
    with pytest.raises(UserError, match=r"07\.png"):
        capture.write(given=folder)
    assert not capture.file(7).exists()


def test_alpha_is_the_mask(capture):
    """Of photographs that have one."""
    for one, mask in zip(capture.photographs, capture.truth, strict=True):
        rgb = np.array(Image.open(capture.folder / one.name).convert("RGB"))
        Image.fromarray(np.dstack([rgb, np.uint8(255 * mask)])).save(capture.folder / one.name)
    assert f"{VIEWS} of their alpha" in capture.write()
    assert (capture.agreement() == 1).all()


def test_a_uniform_background_is_cut_out_without_a_vote(capture):
    """But for holes that the object encloses."""
    for one, mask in zip(capture.photographs, capture.truth, strict=True):
        rgb = np.array(Image.open(capture.folder / one.name).convert("RGB"))
        rgb[~mask] = (230, 20, 220)
        Image.fromarray(rgb).save(capture.folder / one.name)
    assert f"{VIEWS} before a uniform background" in capture.write()


PROGRAM = """
import sys
from PIL import Image
mask = Image.open(sys.argv[1]).convert("L").point(lambda v: 255 if v > 90 else 0)
mask.save(sys.argv[2])
"""


def program(tmp_path, text):
    """The command of a Python program in a folder whose name has a space."""
    file = tmp_path / "a program" / "mask.py"
    file.parent.mkdir()
    file.write_text(text)
    return f"{shlex.quote(sys.executable)} {shlex.quote(str(file))} {{image}} {{mask}}"


def test_a_program_makes_the_masks(capture, tmp_path):
    """It is given each photograph and where to write."""
    capture.photographs = capture.photographs[:2]
    capture.seen = capture.seen[:2]
    assert "2 by the program" in capture.write(command=program(tmp_path, PROGRAM))
    gray = np.array(Image.open(capture.folder / "images/01.png").convert("L"))
    assert (read_gray(capture.file(1)) == np.where(gray > 90, 255, 0)).all()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import sys\nprint('x', file=sys.stderr)\nsys.exit('no weights')", "no weights"),
        ("", "00.png"),
        (PROGRAM.replace("mask.save", "mask.crop((0, 0, 9, 9)).save"), "size"),
        (PROGRAM.replace("mask.save(", "open('/dev/null', 'w') and open("), "00.png"),
    ],
)
def test_a_program_that_fails_is_named(capture, tmp_path, text, said):
    """With the photograph and its last word."""
    with pytest.raises(UserError, match=said) as caught:
        capture.write(command=program(tmp_path, text))
    assert "00.png" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not capture.file(0).exists()


@pytest.mark.parametrize("command", ["", "rembg {image}", "rembg '{image} {mask}"])
def test_a_command_that_cannot_be_one_is_refused(command):
    """Before anything is read."""
    with pytest.raises(UserError, match="--mask-command"):
        program_words(command)


def test_a_box_without_points_is_refused(capture):
    """There is nothing to begin with."""
    capture.box = np.array([[2.0, 2.0, 2.0], [2.1, 2.1, 2.1]])
    with pytest.raises(UserError, match="--box"):
        capture.write()
