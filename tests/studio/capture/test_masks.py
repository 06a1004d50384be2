import shlex
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import (
    binary_dilation,
    binary_erosion,
    gaussian_filter,
)
from support.refused import refusing
from support.scenes import ball_image, ring_cameras

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import read_mask, read_rgba
from pp_cl.scene.demo import OBJECT_BOX, demo_mesh, render
from pp_cl.scene.image_file import ImageFile
from tools.capture_demo import ROOM, cameras, room

pytest.importorskip("cv2")

from pp_studio.capture import cut
from pp_studio.capture.cut import Window, window
from pp_studio.capture.masks import mask_file, outline_sheet, program_words, write_masks

SIZE, VIEWS = 96, 12
SCREEN = (20, 200, 60)
WALL = [0.25, 0.55, 0.3]  # mean colour of the wall


class Capture:
    """An object before walls of noise: photographs in a folder, true masks, sparse points.

    views: (camera, (H, W, 4) uint8) pairs. surface: (N, 3). spoil: changes the first photographs,
    `spoiled` of them. wall: returns the colours behind the object for a camera; if None, each image
    has noise of its own.
    """

    def __init__(self, folder, views, box, surface, spoil=None, spoiled=1, wall=None):
        rng = np.random.default_rng(3)
        self.folder, self.box = folder, 1.06 * np.array(box)
        (folder / "images").mkdir(parents=True)
        self.truth, self.image_files, self.seen = [], [], []
        on_wall = rng.normal(size=(2000 if wall else 600, 3))
        on_wall *= ROOM / np.linalg.norm(on_wall, axis=1, keepdims=True)
        self.points, self.count = np.concatenate([surface, on_wall]), len(surface)
        for i, (camera, image) in enumerate(views):
            rgba = image / 255
            noise = gaussian_filter(rng.uniform(0, 1, rgba[..., :3].shape), (1.5, 1.5, 0))
            behind = wall(camera) if wall else 1.2 * (noise - noise.mean()) + WALL
            image = rgba[..., :3] * rgba[..., 3:] + behind * (1 - rgba[..., 3:])
            if i < spoiled and spoil:
                spoil(image)
            image_file = ImageFile(f"images/{i:02d}.png", camera)
            Image.fromarray(np.uint8(255 * np.clip(image, 0, 1))).save(folder / image_file.name)
            self.image_files.append(image_file)
            self.truth.append(rgba[..., 3] > 0.5)
            whole = Window("", image, camera, (0, 0, SIZE, SIZE))
            indices, rows, columns = whole.inside(self.points)
            is_shown = self.truth[-1][rows, columns] == (indices < self.count)
            self.seen.append(indices[is_shown & (rng.uniform(size=len(indices)) < 0.5)])

    def write(self, **options):
        line, _, self.box = write_masks(
            self.folder, self.image_files, self.box, self.points, self.seen, **options
        )
        return line

    def agreement(self):
        masks = [read_mask(self.file(i)) > 127 for i in range(len(self.truth))]
        pairs = zip(masks, self.truth, strict=True)
        return np.array([(a & b).sum() / (a | b).sum() for a, b in pairs])

    def file(self, number):
        return mask_file(self.folder, self.image_files[number].name)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(cut, "CELLS", 48**3)


def ball(folder, spoil=None, spoiled=1, count=VIEWS):
    cameras = ring_cameras(count, SIZE)
    views = [(camera, ball_image(camera) * np.uint8([1, 0, 1, 1])) for camera in cameras]
    surface = np.random.default_rng(5).normal(size=(200, 3))
    surface *= 0.78 / np.linalg.norm(surface, axis=1, keepdims=True)
    return Capture(folder, views, [[-0.8] * 3, [0.8] * 3], surface, spoil, spoiled)


@pytest.fixture
def capture(tmp_path):
    return ball(tmp_path / "scene")


def given_masks(capture, folder):
    folder.mkdir()
    for image_file, mask in zip(capture.image_files, capture.truth, strict=True):
        Image.fromarray(np.uint8(255 * mask)).save(folder / Path(image_file.name).name)
    return folder


def test_the_object_is_cut_out_of_any_background(capture):
    line = capture.write()
    assert f"{VIEWS} cut out" in line
    assert capture.agreement().min() > 0.95
    assert len(np.unique(read_mask(capture.file(0)))) > 4, "no soft border"


@pytest.mark.slow
def test_a_box_that_cuts_the_object_grows(capture):
    whole, cut_off = capture.box.copy(), capture.box.copy()
    cut_off[1, [0, 2]] = 0.4
    capture.box = cut_off
    held = (capture.points[: capture.count] < cut_off[1]).all(1)
    is_seen = np.append(held, np.ones(len(capture.points) - capture.count, bool))
    capture.seen = [indices[is_seen[indices]] for indices in capture.seen]
    capture.write()
    assert capture.agreement().min() < 0.8 and (capture.box == cut_off).all()
    for i in range(VIEWS):
        capture.file(i).unlink()
    boxes = []
    capture.write(grows=True, grown=boxes.append)
    assert (boxes[-1] == capture.box).all()
    assert capture.agreement().min() > 0.95
    assert (capture.box[1, [0, 2]] > 0.8).all() and capture.box[0, 2] == cut_off[0, 2]
    assert (np.abs(capture.box) < 1.3 * whole[1]).all()


def turned(folder, views, box, surface, wall):
    """A Capture of an object that turns. Its wall stands still, and so has no points."""
    return without_wall(Capture(folder, views, box, surface, wall=wall))


def without_wall(capture):
    """Removes the wall's points from a Capture."""
    capture.points = capture.points[: capture.count]
    capture.seen = [indices[indices < capture.count] for indices in capture.seen]
    return capture


def test_what_looks_the_same_while_the_object_turns_may_be_its_part(tmp_path):
    """A plain ball lies on one with a pattern, before cameras at two heights."""
    middle, views, plain = np.array([0, 0, 1.05]), [], []
    for camera in ring_cameras(2 * VIEWS, SIZE, distance=6.0):
        image = ball_image(camera)
        from_below = replace(camera, pose=camera.pose - np.outer(middle, [0, 0, 0, 1]))
        plain.append(ball_image(from_below, 0.35)[..., 3] > 0)
        image[plain[-1]] = [60, 30, 40, 255]
        views.append((camera, image))

    def wall(camera):
        noise = np.random.default_rng(int(100 * camera.eye[2])).uniform(0, 1, (SIZE, SIZE, 3))
        return 1.2 * (gaussian_filter(noise, (1.5, 1.5, 0)) - 0.5) + WALL

    box = [[-0.8, -0.8, -0.8], [0.8, 0.8, 1.4]]
    capture = turned(tmp_path / "scene", views, box, np.zeros((1, 3)), wall)
    windows, masks = [], []
    for image_file, *images in zip(capture.image_files, capture.truth, plain, strict=True):
        windows.append(
            window(read_rgba(capture.folder / image_file.name)[..., :3], image_file, capture.box)
        )
        masks.append([windows[-1].reduced(np.uint8(image)) > 0 for image in images])
        windows[-1].mask = masks[-1][0]
    beside = [~binary_dilation(mask, iterations=3) for mask, _ in masks]
    for difference, (mask, same), out in zip(
        cut.differences(windows, capture.points, beside), masks, beside, strict=True
    ):
        assert (difference[out] <= cut.SLIGHT).all()
        assert (difference[mask & ~binary_dilation(same, iterations=2)] > 50).all()
        assert (difference[binary_erosion(same, iterations=2)] == cut.UNSEEN).all()


def share_held(capture, place, wanted):
    """Shares of the pixels in `place` of the first photograph that belong to the object (wanted) or
    not, which the mask holds: [without votes, with them].
    """
    shares = []
    for rounds in (0, cut.ROUNDS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cut, "ROUNDS", rounds)
            capture.write()
        chosen = capture.truth[0][place] == wanted
        shares.append((read_mask(capture.file(0)) > 127)[place][chosen].mean())
        for number in range(len(capture.truth)):
            capture.file(number).unlink()
    return shares


def test_the_other_views_carve_what_one_takes_for_the_object(tmp_path):
    place = np.s_[20:40, 16:40]

    def bystander(image):
        image[place] = image[38:58, 36:60]

    capture = ball(tmp_path / "scene", bystander)
    capture.seen[0] = capture.seen[0][capture.seen[0] < capture.count]  # the wall is hidden
    alone, voted = share_held(capture, place, wanted=False)
    assert alone > 0.5
    assert voted < 0.6 * alone


@pytest.mark.parametrize("spoiled", [1, 3])
def test_the_other_views_restore_what_few_take_for_the_background(tmp_path, spoiled):
    place = np.s_[40:56, 40:56] if spoiled == 1 else np.s_[24:72, 24:72]

    def stain(image):
        image[place] = WALL

    capture = ball(tmp_path / "scene", stain, spoiled, count=VIEWS if spoiled == 1 else 40)
    if spoiled > 1:
        capture = without_wall(capture)
    for i in range(spoiled):  # their points on the object are not seen
        capture.seen[i] = capture.seen[i][capture.seen[i] >= capture.count]
    alone, voted = share_held(capture, place, wanted=True)
    assert alone < 0.2
    assert voted > 0.8


def test_a_mask_that_the_user_has_written_has_the_shape_of_its_image(capture):
    capture.write()
    with Image.open(capture.file(3)) as mask:
        mask.resize((SIZE // 2, SIZE // 2)).save(capture.file(3))
    with pytest.warns(UserWarning, match="masks are resized"):
        assert "kept" in capture.write()
    with pytest.warns(UserWarning, match="masks are resized"):
        outline_sheet(capture.folder, capture.image_files)
    Image.fromarray(np.zeros((SIZE, SIZE // 2), np.uint8)).save(capture.file(3))
    with pytest.raises(UserError, match="make it the image's size"):
        capture.write()


def test_given_masks_come_first(capture, tmp_path):
    """They fit the photographs before undistortion, and have the names of these or of their
    sources, which may contain spaces.
    """
    folder, names = given_masks(capture, tmp_path / "given"), []
    (folder / "03.png").rename(folder / "my photo (3).png")
    sources = {"03.png": "my photo (3).JPG"}

    def fitted(name, mask):
        names.append(name)
        return mask[::-1]

    assert f"{VIEWS} given" in capture.write(given=folder, sources=sources, fitted=fitted)
    capture.truth = [mask[::-1] for mask in capture.truth]
    assert (capture.agreement() == 1).all() and len(set(names)) == VIEWS


def test_one_mask_is_not_taken_for_photographs_of_two_rounds(capture, tmp_path):
    folder = given_masks(capture, tmp_path / "given")
    sources = {"03.png": "near/03.png", "04.png": "far/03.png"}
    with pytest.raises(UserError, match="03.png: the mask of near/03.png and of far/03.png"):
        capture.write(given=folder, sources=sources)
    assert not capture.file(0).exists()
    for source in sources.values():
        (folder / source).parent.mkdir()
    (folder / "03.png").rename(folder / "near/03.png")
    (folder / "04.png").rename(folder / "far/03.png")
    assert f"{VIEWS} given" in capture.write(given=folder, sources=sources)
    assert (capture.agreement() == 1).all()


def test_masks_that_contradict_the_others_are_named(capture, tmp_path):
    folder = given_masks(capture, tmp_path / "given")
    wrong = np.roll(capture.truth[4], SIZE // 3, axis=1)
    Image.fromarray(np.uint8(255 * wrong)).save(folder / "04.png")
    assert "04.png" in capture.write(given=folder)


def test_alpha_is_the_mask(capture):
    for image_file, mask in zip(capture.image_files, capture.truth, strict=True):
        rgb = np.array(Image.open(capture.folder / image_file.name).convert("RGB"))
        Image.fromarray(np.dstack([rgb, np.uint8(255 * mask)])).save(
            capture.folder / image_file.name
        )
    assert f"{VIEWS} of their alpha" in capture.write()
    assert (capture.agreement() == 1).all()


def before_a_screen(capture):
    for image_file, mask in zip(capture.image_files, capture.truth, strict=True):
        rgb = np.array(Image.open(capture.folder / image_file.name).convert("RGB"))
        rgb[~mask] = SCREEN
        Image.fromarray(rgb).save(capture.folder / image_file.name)


def test_a_uniform_background_shows_through_gaps(dev, tmp_path):
    """The object is the demo, whose rings enclose most of the background."""
    around = cameras(2 * SIZE, "turntable")[:: 72 // VIEWS]
    views = [(camera, render(dev, camera)) for camera in around]
    surface = demo_mesh(dev, 64)[0][::20]
    capture = turned(tmp_path / "scene", views, OBJECT_BOX, surface, room)
    before_a_screen(capture)
    assert f"{VIEWS} before a uniform background" in capture.write()
    assert capture.agreement().min() > 0.9


def test_an_object_of_the_backgrounds_colour_is_refused(capture):
    """Its points show where it is, but its mask would not contain them."""
    before_a_screen(capture)
    for image_file, mask in zip(capture.image_files, capture.truth, strict=True):
        rgb = np.array(Image.open(capture.folder / image_file.name))
        rows, columns = np.nonzero(mask)
        rgb[rows[: -len(rows) // 3], columns[: -len(rows) // 3]] = SCREEN
        Image.fromarray(rgb).save(capture.folder / image_file.name)
    with pytest.raises(UserError, match="another colour, or give masks with --masks"):
        capture.write()


def test_spots_of_the_backgrounds_colour_are_no_gaps(capture):
    """A few views see the spot on the ball, but the others see the ball behind it."""
    before_a_screen(capture)
    spotted = 0
    for image_file in capture.image_files:
        spot = image_file.camera.project(np.array([[0.75, 0.1, 0.25]]))
        if spot[2][0] < np.linalg.norm(image_file.camera.eye) - 0.6:
            x, y = (int(place[0]) for place in spot[:2])
            rgb = np.array(Image.open(capture.folder / image_file.name))
            rgb[y - 3 : y + 4, x - 3 : x + 4] = SCREEN
            Image.fromarray(rgb).save(capture.folder / image_file.name)
            spotted += 1
    assert f"{VIEWS} before a uniform background" in capture.write()
    assert spotted == 3 and (capture.agreement() > 0.99).all()


PROGRAM = """
import sys
from PIL import Image
mask = Image.open(sys.argv[1]).convert("L").point(lambda v: 255 if v > 90 else 0)
mask.save(sys.argv[2])
"""


def program(tmp_path, text):
    file = tmp_path / "a program" / "mask.py"
    file.parent.mkdir()
    file.write_text(text)
    return f"{shlex.quote(sys.executable)} {shlex.quote(str(file))} {{image}} {{mask}}"


def test_a_program_makes_the_masks(capture, tmp_path):
    capture.image_files, capture.seen = capture.image_files[:2], capture.seen[:2]
    cut_out = "cut = Image.open(sys.argv[1]).convert('RGB')\ncut.putalpha(mask)\ncut.save"
    text = PROGRAM.replace("mask.save", cut_out)
    assert "2 by the program" in capture.write(command=program(tmp_path, text))
    gray = np.array(Image.open(capture.folder / "images/01.png").convert("L"))
    assert (read_mask(capture.file(1)) == np.where(gray > 90, 255, 0)).all()


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
    with refusing("00.png", said):
        capture.write(command=program(tmp_path, text))
    assert not capture.file(0).exists()


@pytest.mark.parametrize("command", ["", "rembg {image}", "rembg '{image} {mask}"])
def test_a_command_that_cannot_be_one_is_refused(command):
    with pytest.raises(UserError, match="--mask-command"):
        program_words(command)


BOXES = {
    "nothing in it": [[2.0, 2.0, 2.0], [2.1, 2.1, 2.1]],
    "flat things on its floor alone": [[-0.8, -0.8, 0.76], [0.8, 0.8, 1.6]],
    "no photograph shows it": [[0, 0, 40.0], [1, 1, 41.0]],
}


@pytest.mark.parametrize("case", BOXES)
def test_a_box_without_an_object_is_refused(capture, case):
    capture.box = np.array(BOXES[case])
    with pytest.raises(UserError, match="--box"):
        capture.write()


def test_a_image_beside_the_object_has_an_empty_mask(capture):
    """Videos may have such images at the beginning or end; the others are cut out nevertheless."""
    photo = capture.image_files[3]
    eye, ahead = 3 * photo.camera.eye, photo.camera.pose[:, 2] + 0.84 * photo.camera.pose[:, 0]
    camera = Camera.look_at(eye, eye + ahead, fx=photo.camera.fx, width=SIZE, height=SIZE)
    capture.image_files[3] = replace(photo, camera=camera)
    line = capture.write()
    assert f"1 empty, as the object is outside, {VIEWS - 1} cut out" in line
    assert not read_mask(capture.file(3)).any()
    assert np.delete(capture.agreement(), 3).min() > 0.9


@pytest.mark.parametrize(
    "system, command, program",
    [
        ("nt", r"C:\tools\rembg.exe {image} {mask}", r"C:\tools\rembg.exe"),
        ("nt", r'"C:\my tools\rembg.exe" i {image} {mask}', r"C:\my tools\rembg.exe"),
        ("nt", r"C:\O'Neil\rembg.exe {image} {mask}", r"C:\O'Neil\rembg.exe"),
        ("posix", """'"rembg"' i {image} {mask}""", '"rembg"'),
        ("posix", r"/my\ tools/rembg i {image} {mask}", "/my tools/rembg"),
        ("posix", "'/my tools/rembg' i {image} {mask}", "/my tools/rembg"),
    ],
)
def test_the_program_of_a_command_on_each_system(monkeypatch, system, command, program):
    monkeypatch.setattr("pp_studio.capture.masks.os", SimpleNamespace(name=system))
    words = program_words(command)
    assert words[0] == program and words[-2:] == ["{image}", "{mask}"]
