import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter
from support.guarded import slow
from support.runs import spoken

from pp_cl.cli import main
from pp_cl.drivers import open_device
from pp_cl.engine.camera import Camera
from pp_cl.files.image import read_mask, read_rgba, to_8bit, write_png
from pp_cl.scene.demo import render
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lens import LensDistortion, undistort
from pp_cl.scene.listing import scene_format, scene_frames
from pp_cl.scene.load import load_scene
from pp_studio.capture import poses, stages
from pp_studio.capture.features import quiet, verification
from pp_studio.capture.frames import take_images, undistorted_mask
from pp_studio.video import write_video
from tools.capture_demo import align, cameras, room

colmap = pytest.importorskip("pycolmap")
SIZE, COUNT = 300, 12
WRONG = 6.0  # times the true focal length


def near():
    arc_cameras = []
    for i in range(COUNT):
        turn, height, distance = i * np.pi / 18, 0.25 + 0.1 * (i % 3), 3 + 0.25 * (i % 3)
        ahead = [np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]
        eye, fx = distance * np.array(ahead), cameras(SIZE)[0].fx
        arc_cameras.append(Camera.look_at(eye, (0, 0, 0), fx=fx, width=SIZE, height=SIZE))
    return arc_cameras


def photograph(folder):
    for name in ("photographs", "masks"):
        (folder / name).mkdir(parents=True)
    for i, camera in enumerate(near()):
        rgba = render(open_device(), camera)
        alpha = rgba[..., 3:] / 255
        write_png(
            folder / "photographs" / f"{i:03d}.png",
            rgba[..., :3] / 255 * alpha + room(camera) * (1 - alpha),
        )
        write_png(folder / "masks" / f"{i:03d}.png", rgba[..., 3])
    words = folder / "photographs", folder / "scene", "--masks", folder / "masks"
    assert capture(*words) == (0, [])


@pytest.fixture(scope="module")
def captured(runs, tmp_path_factory):
    made, folder = runs.made("captured", photograph), tmp_path_factory.mktemp("captured") / "made"
    shutil.copytree(made, folder)
    options = folder / "scene" / "capture" / "options.json"
    options.write_text(options.read_text().replace(str(made), str(folder)))
    return folder / "scene"


@pytest.fixture(scope="module")
def shot(captured):
    return captured.parent / "photographs", captured.parent / "masks"


def capture(source, scene, *more):
    """(exit status, lines on stderr without progress) of the command."""
    status, lines = spoken(["capture", source, "--out", scene, *more])
    return status, [line for line in lines if line.startswith("pp-cl")]


def refused(source, scene, *more, named):
    status, lines = capture(source, scene, *more)
    assert status == 2 and len(lines) == 1 and str(named) in lines[0], lines


def found(scene, stage):
    return json.loads((scene / "capture" / f"{stage}.json").read_text())


def changed(scene):
    return {p: p.stat().st_mtime_ns for p in scene.rglob("*") if p.is_file() and p.name[0] != "."}


def off(scene, true=None):
    placed = [view for split in ("train", "test") for view in scene_frames(scene, split)]
    places = [int(Path(view.name).stem) for view in placed]
    return align([view.camera for view in placed], [(true or near())[i] for i in places])


def test_photographs_become_a_scene(captured):
    assert scene_format(captured) == "transforms" and off(captured).position < 0.03
    assert off(captured).degrees < 4  # places on an arc hardly fix the rotation
    views = load_scene(captured, ("train", "test")).splits
    assert (len(views["train"]), len(views["test"])) == (10, 2)
    box = np.array(json.loads((captured / "transforms.json").read_text())["aabb"])
    assert np.abs(box).max() == pytest.approx(1) and np.abs(box).min() > 0.3
    for view in (*views["train"], *views["test"]):
        rows, columns = np.nonzero(view.image[..., 3] > 127)
        middle = view.camera.project(np.zeros(3))[:2]
        assert np.linalg.norm(middle - [columns.mean(), rows.mean()]) < 0.1 * SIZE
        assert -view.camera.pose[2, 1] > 0  # the image's top points up


def test_the_scene_states_no_digits_that_threads_decide(captured):
    """Two captures of 49 photographs differed by 1e-14, which a training amplifies."""
    decimals = re.findall(r"\.(\d+)", (captured / "transforms.json").read_text())
    assert max(map(len, decimals)) == 9


def test_nothing_in_the_scene_is_distorted(captured):
    splits = [scene_frames(captured, split) for split in ("train", "test")]
    first = splits[0][0]
    assert not any(view.lens for split in splits for view in split)
    model = colmap.Reconstruction(captured / "sparse" / "0")
    focal, _, cx, cy = model.camera(1).params
    assert (focal, cx, cy) == pytest.approx((first.camera.fx, first.camera.cx, first.camera.cy))
    bent = colmap.Reconstruction(captured / "capture" / "model")
    k1 = bent.camera(1).params[3]
    assert abs(k1) > 1e-5
    frame = read_rgba(captured / "capture" / "frames" / Path(first.name).name)
    straight = undistort(open_device(), frame, first.camera, LensDistortion(k1))
    np.testing.assert_array_equal(read_rgba(captured / first.name), straight)


@pytest.mark.slow
def test_a_focal_length_that_is_wrong_is_forgotten(captured, tmp_path):
    """EXIF may keep the focal length of larger photographs. With it, few images would be placed."""
    work = captured / "capture"
    database = Path(shutil.copy(work / "database.db", tmp_path))
    with quiet(database), colmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            params = [WRONG * cameras(SIZE)[0].fx, SIZE / 2, SIZE / 2, 0]
            camera.params, camera.has_prior_focal_length = params, True
            db.update_camera(camera)
        db.clear_two_view_geometries()
        colmap.geometric_verification(database, two_view_geometry_options=verification(colmap))
    taken = found(captured, "frames")["images"]
    facts = poses.place(database, work / "frames", tmp_path / "model", taken, False)
    assert facts["placed"] == COUNT
    lens = colmap.Reconstruction(tmp_path / "model").cameras.values()
    assert [camera.params[0] for camera in lens] == pytest.approx(
        [cameras(SIZE)[0].fx] * len(lens), 0.1
    )


def test_wrong_matches_do_not_pull_at_the_cameras():
    """In each photograph, one point of twenty is off by some pixels, as if a pattern was
    mismatched.
    """
    colmap.set_random_seed(0)
    model = colmap.synthesize_dataset(
        colmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=12, num_points3D=400)
    )
    true = [image_file.camera for image_file in poses.image_files(model)]
    rng = np.random.default_rng(0)
    for image in model.images.values():
        for point in image.points2D:
            if point.has_point3D():
                point.xy = point.xy + rng.normal(0, 4 if point.point3D_id % 20 == 0 else 0.2, 2)
    poses.refine(model)
    alignment = align([image_file.camera for image_file in poses.image_files(model)], true)
    assert alignment.position < 0.001 and alignment.degrees < 0.02


def test_what_is_done_is_not_done_again(captured, shot, tmp_path):
    scene = shutil.copytree(captured, tmp_path / "scene")
    words = shot[0], scene, "--masks", shot[1]
    before = changed(scene)
    assert capture(*words) == (0, []) and changed(scene) == before
    for name in ("masks.json", "scene.json"):  # as if killed before these were written
        (scene / "capture" / name).unlink()
    assert capture(*words) == (0, [])
    after = changed(scene)
    assert after[scene / "capture" / "poses.json"] == before[scene / "capture" / "poses.json"]
    assert after[scene / "capture" / "masks.json"] > before[scene / "capture" / "masks.json"]
    refused(shot[1], scene, named=scene)


def test_options_are_kept_for_the_next_capture(captured, shot, tmp_path, capsys):
    scene = shutil.copytree(captured, tmp_path / "scene")
    words, before = ["capture", str(shot[0]), "--out", str(scene)], changed(scene)
    assert main(words) == 0 and changed(scene) == before
    capsys.readouterr()
    assert main([*words, "--box=-0.5,-0.5,-0.5,0.5,0.5,0.5"]) == 0
    printed = capsys.readouterr().out
    assert "--box has changed: box and all after it are repeated" in printed
    assert "poses: 12 of 12" in printed
    assert found(scene, "masks")["line"].startswith(f"{COUNT} given")
    assert main([*words, "--from", "scene"]) == 0
    assert json.loads((scene / "transforms.json").read_text())["aabb"] == [[-0.5] * 3, [0.5] * 3]
    assert main([*words, "--box", "auto"]) == 0
    box = json.loads((captured / "transforms.json").read_text())["aabb"]
    assert json.loads((scene / "transforms.json").read_text())["aabb"] == box


def test_photographs_that_have_moved_are_the_same(captured, shot, tmp_path):
    scene = shutil.copytree(captured, tmp_path / "scene")
    moved, options = shutil.copytree(shot[0], tmp_path / "moved"), scene / "capture/options.json"
    refused(moved, scene, named="was made from")
    options.write_text(options.read_text().replace(str(shot[0]), str(tmp_path / "gone")))
    before = changed(scene)
    assert capture(moved, scene) == (0, [])
    assert {path for path, time in changed(scene).items() if before[path] != time} == {options}
    options.write_text(options.read_text().replace(str(moved), str(tmp_path / "gone")))
    next(moved.iterdir()).unlink()
    refused(moved, scene, named="was made from")


def test_distortion_is_removed_on_the_device_that_is_named(captured, shot, tmp_path):
    scene = shutil.copytree(captured, tmp_path / "scene")
    refused(shot[0], scene, "--from", "images", "--device", "no such", named="device 'no such'")


@pytest.mark.parametrize(
    "source, words, named",
    [
        (None, ("--masks", "mask"), "mask"),
        (None, ("--masks", "few"), "no mask for 001.png"),
        (None, ("--mask-command", "no-such-program {image} {mask}"), "no-such-program"),
        (None, ("--mask-command", "python"), "python"),
        ("few", ("--from", "frames"), "1 photographs"),
    ],
    ids=["no folder", "too few", "no program", "no words", "too few photographs"],
)
def test_an_option_that_cannot_do_changes_nothing(
    captured, shot, tmp_path, monkeypatch, source, words, named
):
    scene = shutil.copytree(captured, tmp_path / "scene")
    (tmp_path / "few").mkdir()
    shutil.copy(shot[0] / "000.png", tmp_path / "few")
    monkeypatch.chdir(tmp_path)
    before = changed(scene)
    refused(source or shot[0], scene, *words, named=named)
    assert changed(scene) == before


def test_a_folder_that_no_capture_has_made_is_left_alone(shot, tmp_path):
    mug = tmp_path / "mug"
    for name in ("capture", "images", "masks"):
        (mug / name).mkdir(parents=True)
    shutil.copy(shot[0] / "000.png", mug / "capture")
    for name in ("images/0.png", "masks/0.png", "transforms.json", "capture/frames.json"):
        (mug / name).write_text("mine")
    before = changed(mug)
    refused(mug / "capture", mug, named=mug)
    assert changed(mug) == before


def test_what_is_the_users_stays(captured, shot, tmp_path):
    scene = shutil.copytree(captured, tmp_path / "scene")
    own = scene / "capture" / "frames" / "003.png"
    own.write_bytes(own.read_bytes() + b"mine")
    before = changed(scene)
    assert capture(shot[0], scene, "--from", "frames") == (
        2,
        [f"pp-cl: {own}: pp-cl did not write this, or it was changed since; move it away"],
    )
    assert changed(scene) == before
    shutil.copy(captured / "capture" / "frames" / "003.png", own)
    mine = [path / "mine.png" for path in (scene, *scene.rglob("*")) if path.is_dir()]
    for path in mine:
        path.write_text("mine")
    assert capture(shot[0], scene) == (0, [])
    assert capture(shot[0], scene, "--from", "images")[0] == 2
    assert all(path.read_text() == "mine" for path in mine)


def test_masks_that_the_user_has_mended_are_kept(captured, shot, tmp_path):
    """If their images must be made anew, the command refuses and names the mask; --replace-masks
    replaces it.
    """
    scene = shutil.copytree(captured, tmp_path / "scene")
    mended = scene / "masks" / "003.png"
    Image.new("L", (SIZE, SIZE), 255).save(mended)
    mine = mended.read_bytes()
    assert capture(shot[0], scene, "--from", "box") == (0, []) and mended.read_bytes() == mine
    assert found(scene, "masks")["line"].startswith(f"1 kept, {COUNT - 1} given")
    before = changed(scene)
    refused(shot[0], scene, "--from", "images", named=mended)
    assert changed(scene) == before
    assert capture(shot[0], scene, "--from", "masks", "--replace-masks") == (0, [])
    assert mended.read_bytes() == (captured / "masks" / "003.png").read_bytes()


def test_photographs_that_came_later_are_told(captured, shot, tmp_path, capsys):
    """They are only reported: taking them would delete the masks that the user has mended."""
    scene, later = shutil.copytree(captured, tmp_path / "scene"), shot[0] / "later.jpg"
    later.touch()
    try:
        assert main(["capture", str(shot[0]), "--out", str(scene), "--masks", str(shot[1])]) == 0
    finally:
        later.unlink()
    expected = f"frames: {COUNT} images (done before; later.jpg came later: --from frames takes all"
    assert expected in capsys.readouterr().out


def strangers(files, folder):
    for k, file in enumerate(files):
        colours = np.random.default_rng(k).integers(0, 255, (40, 40, 3), np.uint8)
        Image.fromarray(colours).resize((SIZE, SIZE), Image.Resampling.BICUBIC).save(
            folder / file.name
        )


def nothing(files, folder):
    (folder / "notes.txt").write_text("none")


@pytest.mark.parametrize("make", [slow(strangers), nothing])
def test_photographs_of_no_use(shot, tmp_path, make):
    folder, scene = tmp_path / "folder", tmp_path / "scene"
    folder.mkdir()
    make(sorted(shot[0].iterdir()), folder)
    refused(folder, scene, named=tmp_path)
    assert not (scene / "transforms.json").exists()


def test_videos(shot, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    sharp = [np.array(Image.open(file)) for file in sorted(shot[0].iterdir())]
    soft = [np.array(Image.fromarray(image).filter(ImageFilter.GaussianBlur(3))) for image in sharp]
    frames = [frame for two in zip(soft, sharp, strict=True) for frame in two] * 10
    write_video(tmp_path / "video.mp4", frames, 24)  # 240 frames, every second one sharp
    taken = take_images(tmp_path / "video.mp4", tmp_path / "images")["images"]
    chosen = [int(image["name"][:6]) for image in taken]
    assert len(chosen) > 100 and all(number % 2 for number in chosen)
    black = [to_8bit(np.zeros((64, 96, 3)))] * 30
    write_video(tmp_path / "black.mp4", black, 24)
    refused(tmp_path / "black.mp4", tmp_path / "other", named="shows nothing sharp")
    refused(tmp_path / "missing.mp4", tmp_path / "other", named="missing.mp4")


@pytest.mark.unix
@pytest.mark.slow
def test_a_full_disk(shot, tmp_path):
    """The database cannot grow: one line names it, and with space again the command continues."""
    scene = tmp_path / "scene"
    words = ["capture", str(shot[0]), "--out", str(scene), "--masks", str(shot[1])]
    limited = "import resource as r; r.setrlimit(r.RLIMIT_FSIZE, (3 << 20, 3 << 20))"
    code = f"import sys; {limited}; from pp_cl.cli import program; sys.exit(program({words}))"
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    lines = [line for line in ended.stderr.splitlines() if line.startswith("pp-cl")]
    assert ended.returncode == 2 and len(lines) == 1 and str(scene) in lines[0], ended.stderr
    assert (scene / "capture" / "frames.json").exists()
    assert capture(*words[1:2], scene, *words[4:]) == (0, []) and off(scene).position < 0.03


@pytest.mark.slow
def test_half_of_the_images_have_no_place(shot, tmp_path):
    folder, scene = tmp_path / "folder", tmp_path / "scene"
    shutil.copytree(shot[0], folder)
    names = [f"x{k:02d}.png" for k in range(COUNT)]
    strangers([Path(name) for name in names], folder)
    assert capture(folder, scene, "--masks", shot[1]) == (0, [])
    placed = found(scene, "poses")
    assert placed["placed"] == COUNT and sorted(placed["unplaced"]) == names
    assert f"{COUNT} of {2 * COUNT} " in placed["line"] and names[0] in placed["line"]
    assert off(scene).position < 0.03


def test_what_the_page_changed_is_obeyed(captured, shot, tmp_path):
    scene = shutil.copytree(captured, tmp_path / "scene")
    edits = {"box": [[-0.6] * 3, [0.7] * 3], "dropped": ["images/003.png"]}
    (scene / "pp_cl.json").write_text(json.dumps(edits))
    assert capture(shot[0], scene, "--masks", shot[1], "--from", "masks") == (0, [])
    assert json.loads((scene / "transforms.json").read_text())["aabb"] == edits["box"]
    assert len(list((scene / "masks").iterdir())) == COUNT
    assert found(scene, "masks")["line"].startswith(f"{COUNT - 1} given")
    status, (warning,) = capture(shot[0], scene, "--masks", shot[1], "--box=-1,-1,-1,1,1,1")
    assert status == 0 and "the box set on its page is used in place of --box" in warning
    assert json.loads((scene / "transforms.json").read_text())["aabb"] == edits["box"]


def turned(dev, folder, steps, wall=None):
    true = cameras(SIZE, "turntable")
    wall = room(true[0]) if wall is None else wall
    for name in ("photographs", "masks"):
        (folder / name).mkdir()
    for i in steps:
        rgba = render(dev, true[i])
        alpha = rgba[..., 3:] / 255
        photograph = rgba[..., :3] / 255 * alpha + wall * (1 - alpha)
        write_png(folder / "photographs" / f"{i:03d}.png", photograph)
        write_png(folder / "masks" / f"{i:03d}.png", rgba[..., 3])
    return folder / "photographs", folder / "masks"


@pytest.mark.slow
def test_an_object_that_turns(dev, tmp_path):
    """Cameras are found though the pattern repeats at other steps, and the turning is noticed."""
    scene = tmp_path / "scene"
    photographs, masks = turned(dev, tmp_path, range(14))
    assert capture(photographs, scene, "--masks", masks) == (0, [])
    assert not any((scene / "capture/inside").iterdir())
    assert found(scene, "matches")["turns"] and found(scene, "poses")["placed"] == 14
    assert off(scene, cameras(SIZE, "turntable")).position < 0.01
    before = found(scene, "matches")["line"]
    (scene / "capture/matches.json").unlink()  # as if stopped while matches are removed
    assert capture(photographs, scene, "--masks", masks) == (0, [])
    assert found(scene, "matches")["line"] == before and found(scene, "poses")["placed"] == 14


def test_a_film_on_white_is_placed_and_cut_out_by_itself(dev, tmp_path):
    """No structure stands out behind the object, so colour decides, and the line says so. Half a
    turn also shows the pattern on its other side, which must not draw cameras there.
    """
    scene = tmp_path / "scene"
    photographs, masks = turned(dev, tmp_path, range(36), 1.0)
    film = [read_rgba(file)[..., :3] for file in sorted(photographs.iterdir())]
    write_video(tmp_path / "film.mp4", film, 24)
    assert capture(tmp_path / "film.mp4", scene) == (0, [])
    assert "the background is uniform" in found(scene, "frames")["line"]
    assert "as on a turntable" in found(scene, "matches")["line"]
    assert found(scene, "poses")["placed"] == 36
    true = cameras(SIZE, "turntable")
    assert off(scene, true).position < 0.03 and off(scene, true).degrees < 2
    assert "36 before a uniform background" in found(scene, "masks")["line"]
    shares = []
    for image_file in poses.image_files(colmap.Reconstruction(scene / "capture" / "model")):
        number = int(Path(image_file.name).stem)
        true = undistorted_mask(dev, read_mask(masks / f"{number:03d}.png"), image_file) > 127
        mask = read_mask(scene / "masks" / f"{number:06d}.png") > 127
        shares.append((mask & true).sum() / (mask | true).sum())
    assert np.mean(shares) > 0.95


@pytest.mark.slow
def test_a_wall_places_no_cameras(dev, tmp_path):
    """The object turns by too much between its photographs."""
    scene = tmp_path / "scene"
    refused(turned(dev, tmp_path, range(0, 72, 8))[0], scene, named=scene)
    assert found(scene, "matches")["turns"] and (scene / "capture" / "turns").exists()


def test_photographs_of_bursts_are_held_out_together(tmp_path):
    """Two photographs from each of eighteen places; one place alone is left to the readers."""
    cameras = [
        Camera.look_at(
            (4 * np.cos(turn), 4 * np.sin(turn), shake), (0, 0, 0), fx=50, width=9, height=9
        )
        for turn in np.arange(18) / 3
        for shake in (1, 1.05)
    ]
    listed = [ImageFile(f"images/{i:03d}.jpg", camera) for i, camera in enumerate(cameras)]
    lists, twins = stages._splits(listed)
    held = [f"images/{i:03d}.jpg" for i in (0, 1, 16, 17, 32, 33)]
    assert twins == 18 and lists["test_filenames"] == held
    assert sorted(lists["train_filenames"] + held) == [image.name for image in listed]
    assert stages._splits(listed[::2]) == ({}, 0)
