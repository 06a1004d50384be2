import os
import subprocess

import numpy as np
import pytest
from PIL import ExifTags, Image, TiffImagePlugin
from support.profile import display_p3, in_srgb

from pp_cl.errors import UserError
from pp_cl.files.atomic import own, write_json
from pp_cl.files.image import read_rgba
from pp_studio.capture import frames
from pp_studio.capture.features import find_features
from pp_studio.capture.frames import take_images
from pp_studio.capture.stages import Capture
from pp_studio.video import write_video

cv2 = pytest.importorskip("cv2")
MAKER_NOTE, FOCAL = 0x927C, 0x920A
SIZE = 96, 64


@pytest.fixture
def shots():
    """Twelve sharp (64, 96, 3) images, no two of which are alike."""
    return np.random.default_rng(0).integers(0, 256, (12, *SIZE[::-1], 3), np.uint8)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "photographs").mkdir()
    return tmp_path / "photographs"


def test_photographs_of_other_programs(shots, folder, tmp_path):
    """16 bits per channel, CMYK, a TIFF with tags too large for a JPEG, broken EXIF. A truncated
    file and a copy of another image are left out.
    """
    heif = pytest.importorskip("pillow_heif")
    for i, image in enumerate(shots):
        Image.fromarray(image).save(folder / f"{i:02d}.png")
    cv2.imwrite(str(folder / "deep.png"), shots[0, ::-1].astype(np.uint16) * 257)
    Image.fromarray(shots[1, ::-1]).convert("CMYK").save(folder / "print.jpg")
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[34377] = bytes(100_000)  # a tag of Photoshop's
    Image.fromarray(shots[2, ::-1]).save(folder / "layers.tif", tiffinfo=tags)
    for i, name in enumerate(("a.avif", "b.bmp", "c.jfif"), 4):
        Image.fromarray(shots[i, ::-1]).save(folder / name)
    heif.from_pillow(Image.fromarray(shots[7, ::-1])).save(folder / "d.heic")
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    exif.get_ifd(frames.EXIF).update({FOCAL: 4.2, MAKER_NOTE: b"x" * 60_000})
    Image.fromarray(shots[3, ::-1]).save(folder / "turned.jpg", exif=exif)
    plain = np.uint8([110, 70, 60] + shots[8, ..., :1] % 101)
    Image.fromarray(plain).save(folder / "p3.png", icc_profile=display_p3(), exif=exif)
    content = (folder / "turned.jpg").read_bytes()
    (folder / "broken.jpg").write_bytes(content[:30] + b"\xff" * 40 + content[70:])
    (folder / "cut off.jpg").write_bytes(content[: len(content) - 3000])
    Image.fromarray(shots[11]).save(folder / "11b.png")
    taken = take_images(folder, tmp_path / "images")
    made = {photo["source"]: photo for photo in taken["images"]}
    assert {"deep.png", "print.jpg", "layers.tif", "turned.jpg"} <= set(made)
    assert {"a.avif", "b.bmp", "c.jfif", "d.heic"} <= set(made)
    left_out = {photo["source"]: photo["reason"] for photo in taken["left_out"]}
    assert left_out.keys() - {"broken.jpg"} == {"cut off.jpg", "11b.png"}
    assert left_out["11b.png"] == "shows the same as 11.png"
    for photo in made.values():
        size = read_rgba(tmp_path / "images" / photo["name"]).shape[1::-1]
        is_turned = photo["source"] in ("turned.jpg", "p3.png")
        assert size == tuple(photo["size"]) == (SIZE[::-1] if is_turned else SIZE)
    colour = read_rgba(tmp_path / "images" / made["p3.png"]["name"])[..., :3].mean((0, 1))
    assert np.abs(colour - in_srgb(plain.reshape(-1, 3).T).mean(1)).max() < 3
    copy = Image.open(tmp_path / "images" / made["turned.jpg"]["name"]).getexif()
    assert copy.get(ExifTags.Base.Orientation, 1) == 1
    assert copy.get_ifd(frames.EXIF)[FOCAL] == pytest.approx(4.2)


def test_features_are_not_looked_for_where_alpha_is_0(shots, folder, tmp_path):
    """A cut-out may still contain the wall behind the object."""
    pycolmap = pytest.importorskip("pycolmap")
    sharp = np.kron(shots, np.ones((1, 4, 4, 1), np.uint8))
    alpha = np.zeros((*sharp.shape[1:3], 1), np.uint8)
    alpha[60:190, 100:300] = 255
    for i, image in enumerate(sharp):
        Image.fromarray(np.dstack([image, alpha])).save(folder / f"{i:02d}.png")
    capture = Capture(tmp_path / "scene", {"source": str(folder)}, lambda line: None)
    capture.options = {"source": str(folder), "turntable": False}
    capture.work.mkdir(parents=True)
    write_json(capture.work / "frames.json", take_images(folder, capture.frames))
    capture._features()
    with pycolmap.Database.open(capture.database) as db:
        for image in db.read_all_images():
            x, y = db.read_keypoints(image.image_id)[:, :2].T
            assert len(x) > 50 and x.min() > 99 and x.max() < 301 and y.min() > 59 and y.max() < 191


def test_the_focal_length_of_reduced_photographs(shots, folder, tmp_path):
    """EXIF describes the sensor before the photographs were cropped to a square and reduced: 5184
    by 3456 pixels, 5728 to an inch. COLMAP would begin with 46 / 25.4 * 5728 = 10374 pixels.
    """
    pytest.importorskip("pillow_heif")
    pycolmap = pytest.importorskip("pycolmap")
    sensor = dict(zip(frames.SENSOR, (5184, 3456, 5728.0, 2), strict=True))
    lens = {FOCAL: 46.0}
    whole = dict(zip(frames.SENSOR, (64, 64, 30.0, 2), strict=True))
    tags = [lens | sensor, lens | whole, lens, lens | sensor | {FOCAL: 0.0}]
    tags += [lens | sensor | {frames.SENSOR[3]: 7}, lens | sensor | {frames.FOCAL_35: 50}]
    for i, image in enumerate(shots):
        exif = Image.Exif()
        exif.get_ifd(frames.EXIF).update(tags[i] if i < len(tags) else {})
        Image.fromarray(image).resize((64, 64)).save(folder / f"{i:02d}.jpg", exif=exif)
    taken = take_images(folder, tmp_path / "images")["images"]
    focal = 46 / 25.4 * 5728 * 64 / 3456
    assert [photo["focal"] for photo in taken] == [pytest.approx(focal)] + [None] * (len(shots) - 1)
    database = tmp_path / "database.db"
    find_features(database, tmp_path / "images", taken[:1])
    with pycolmap.Database.open(database) as db:
        (camera,) = db.read_all_cameras()
    assert camera.params == pytest.approx([focal, 32, 32, 0])


def test_images_are_numbered_by_name_whichever_is_done_first(tmp_path, rng):
    """Matches and poses depend on the numbers; here the second image takes longest."""
    pycolmap = pytest.importorskip("pycolmap")
    taken = [{"name": f"{i}.png", "lens": "", "size": (600, 600), "focal": None} for i in range(9)]
    taken[0]["size"] = 304, 600
    for i, photo in enumerate(taken):
        values = rng.integers(0, 256, (75, 75), np.uint8) if i == 1 else np.full((75, 75), 100 + i)
        pixels = np.kron(values, np.ones((8, 8))).astype(np.uint8)
        Image.fromarray(pixels[:, : photo["size"][0]]).save(tmp_path / photo["name"])
    counts = find_features(tmp_path / "database.db", tmp_path, taken)
    assert list(counts) == [photo["name"] for photo in taken] and counts["1.png"] > 100
    with pycolmap.Database.open(tmp_path / "database.db") as db:
        assert db.num_frames() == db.num_images() == 9 and db.num_cameras() == 2
        ids = [db.read_image_with_name(photo["name"]).image_id for photo in taken]
    assert ids == list(range(1, 10))


def test_photographs_are_known_by_their_content(shots, folder, tmp_path):
    """Cameras name HEIF .HIF; what looks like a photograph and is not read is named."""
    heif = pytest.importorskip("pillow_heif")
    for i, image in enumerate(shots):
        heif.from_pillow(Image.fromarray(image)).save(folder / "made.heic")
        (folder / "made.heic").rename(folder / f"IMG_{i:02d}.HIF")
    (folder / "IMG_11.HIF").rename(folder / "without ending")
    (folder / "later.jxl").write_bytes(b"\xff\x0a")
    (folder / "notes.txt").write_text("no photograph")
    taken = take_images(folder, tmp_path / "images")
    assert {photo["source"] for photo in taken["images"]} == {
        "without ending",
        *(f"IMG_{i:02d}.HIF" for i in range(11)),
    }
    [unread] = taken["left_out"]
    assert unread["source"] == "later.jxl" and "kind that is not read (.jxl)" in unread["reason"]
    for file in folder.iterdir():
        file.rename(file.with_suffix(".jxl"))
    with pytest.raises(UserError, match=r"no photographs in it .*\.jxl are not read"):
        take_images(folder, tmp_path / "others")


@pytest.mark.parametrize("zoom, lenses", [(1.5, 2), (1, 1), (0, 1)])
def test_a_digital_zoom_is_another_lens(shots, folder, tmp_path, zoom, lenses):
    for i, image in enumerate(shots):
        exif = Image.Exif()
        exif.get_ifd(frames.EXIF).update({FOCAL: 4.3, frames.ZOOM: zoom if i % 3 else 1})
        Image.fromarray(image).save(folder / f"{i:02d}.jpg", exif=exif, quality=95)
    taken = take_images(folder, tmp_path / "images")["images"]
    assert len({photo["lens"] for photo in taken}) == lenses


@pytest.mark.unix
def test_names_that_colmap_can_list(shots, tmp_path):
    """Names are ASCII, without spaces or a leading #, and unique if case is ignored."""
    names = ["#a.png", "_a.png", "b c.png", "b  c.png", "b_c.png", "B_C.PNG", "d.png", "d.jpg"]
    names += ["e.png", os.fsdecode(b"foto_\xe9.png"), os.fsdecode(b"foto_\xea.png")]
    for name, image in zip(names, shots, strict=False):
        Image.fromarray(image).save(tmp_path / name)
    taken = [
        photo["name"].lower() for photo in take_images(tmp_path, tmp_path / "images")["images"]
    ]
    assert len({name.rpartition(".")[0] for name in taken}) == len(names)
    assert all(name.isascii() and " " not in name and name[0] != "#" for name in taken)


@pytest.fixture
def video(shots, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    write_video(
        tmp_path / "video.webm", [np.roll(image, k, 0) for image in shots for k in range(4)], 24
    )
    return tmp_path / "video.webm"


def remade(video, name, *options):
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *options[:-1], "-i", video]
    target = video.with_name(name)
    with target.open("wb") as file:
        subprocess.run([*command, *options[-1], "pipe:1"], stdout=file, check=True)
    return target


def test_a_video_that_states_no_length(video, tmp_path):
    """Browsers record such videos."""
    live = remade(video, "live.webm", ["-c", "copy", "-f", "webm", "-live", "1"])
    whole, other = (take_images(file, tmp_path / file.stem)["images"] for file in (video, live))
    assert [shot["name"] for shot in other] == [shot["name"] for shot in whole] and len(other) > 40


def test_a_video_that_was_cut_off(video, tmp_path):
    """Its head tells of frames that are missing."""
    cut = tmp_path / "cut.webm"
    cut.write_bytes(video.read_bytes()[: video.stat().st_size * 6 // 10])
    with pytest.warns(UserWarning, match=r"only \d+ of its 48 frames are there"):
        take_images(cut, tmp_path / "cut")


def test_a_video_that_is_shown_turned(video, tmp_path, caplog):
    """Phones make such videos: frames are upright, and ffmpeg logs nothing."""
    fragments = ["-c:v", "libx264", "-f", "mp4", "-movflags", "frag_keyframe+empty_moov"]
    flat = remade(video, "flat.mp4", fragments)
    turned = remade(flat, "turned.mp4", "-display_rotation", "90", ["-c", "copy", *fragments[2:]])
    images = take_images(turned, tmp_path / "images")["images"]
    assert {tuple(frame["size"]) for frame in images} == {SIZE[::-1]} and not caplog.records


def display(colour, transfer):
    """BT.2020 signal in [0, 1] with which an HLG or PQ display shows an sRGB colour; white has 203
    candela per square metre (BT.2100, BT.2408).
    """
    level = np.asarray(colour) / 255
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    light = light @ np.array(
        [[0.6274, 0.0691, 0.0164], [0.3293, 0.9195, 0.0880], [0.0433, 0.0114, 0.8956]]
    )
    if transfer == "smpte2084":
        power = (light * 203 / 10_000) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    light = light * 203 / 1000
    scene = light * (light @ [0.2627, 0.678, 0.0593])[..., None] ** (1 / 1.2 - 1)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    dark = np.sqrt(3 * np.minimum(scene, 1 / 12))
    return np.where(scene <= 1 / 12, dark, a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


@pytest.mark.parametrize(
    "transfer, primaries, off",
    [("arib-std-b67", "bt2020", 12), ("smpte2084", "unknown", 5)],
)
def test_a_video_in_hdr_has_the_colours_of_one_in_sdr(tmp_path, transfer, primaries, off):
    """Phones record 10 bits of BT.2020; other programs omit the primaries. ffmpeg applies HLG's
    system gamma to each channel, which changes colours by `off` at most; without tone mapping they
    would be washed out by 30 and more.
    """
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    colours = np.array([(180, 120, 60), (90, 140, 180), (128, 128, 128), (60, 100, 50)], np.uint8)
    frames_ = [
        np.kron(np.roll(colours, i, 0).reshape(2, 2, 3), np.ones((60, 80, 1))) for i in range(12)
    ]
    raw = b"".join(
        (np.clip(display(frame, transfer), 0, 1) * 65535 + 0.5).astype("<u2").tobytes()
        for frame in frames_
    )
    tags = f"color_primaries={primaries}:color_trc={transfer}:colorspace=bt2020nc:range=tv"
    video = tmp_path / "video.mov"
    subprocess.run(
        [
            *(imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "rawvideo"),
            *("-pix_fmt", "rgb48le", "-s", "160x120", "-r", "24", "-i", "-", "-vf"),
            "scale=out_color_matrix=bt2020:out_range=tv,format=yuv420p10le,setparams=" + tags,
            *("-c:v", "libx265", "-x265-params", "log-level=error", str(video)),
        ],
        input=raw,
        check=True,
    )
    images = take_images(video, tmp_path / "images")["images"]
    for frame in images:
        image = read_rgba(tmp_path / "images" / frame["name"])[..., :3].astype(float)
        true = frames_[int(frame["name"][:6])]
        assert np.abs(image.mean((0, 1)) - true.mean((0, 1))).max() < off
        for row, column in ((30, 40), (30, 120), (90, 40), (90, 120)):
            assert np.abs(image[row, column] - true[row, column]).max() < 2 * off


def test_what_is_no_video_is_one_line_without_the_programs_banner(tmp_path):
    (tmp_path / "video.mov").write_bytes(b"no video" * 100)
    with pytest.raises(
        UserError, match=r"cannot be read as a video \(Error opening input"
    ) as caught:
        take_images(tmp_path / "video.mov", tmp_path / "images")
    assert "ffmpeg version" not in str(caught.value)


def test_photographs_of_several_rounds(shots, tmp_path):
    """Each round has a folder, some images lie above them, and numbers lack leading zeros; masks,
    raw files and pp-cl's own images are not taken.
    """
    places = [f"{i}.png" for i in (1, 2, 9, 10)]
    places += [f"{place}/{i}.png" for place in ("low", "high/1") for i in (8, 9, 10, 11)]
    for place, image in zip(places, shots, strict=True):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(tmp_path / place)
    for place in ("masks/1.png", "scene/images/1.png", ".hidden/1.png"):
        (tmp_path / place).parent.mkdir(parents=True)
        Image.fromarray(shots[0]).save(tmp_path / place)
    (tmp_path / "low/7.DNG").write_bytes(b"raw")
    own(tmp_path / "scene")
    taken = take_images(tmp_path, tmp_path / "scene/capture")
    ordered = [*places[:4], *places[8:], *places[4:8]]
    assert [photo["source"] for photo in taken["images"]] == ordered
    names = [photo["name"] for photo in taken["images"]]
    assert names == sorted(names) and names[3] == "000010.png"
    assert len({photo["lens"] for photo in taken["images"]}) == 3, "a lens each"
    [raw] = taken["left_out"]
    assert raw["source"] == "low/7.DNG" and "is raw" in raw["reason"]


def test_what_a_film_repeats_takes_the_place_of_no_other_picture(tmp_path, rng):
    """The film has a constant frame rate: the camera moved for 40 frames, then the last one
    repeats.
    """
    shown = rng.integers(0, 256, (40, *SIZE[::-1], 3), np.uint8)
    write_video(tmp_path / "film.webm", [*shown, *[shown[-1]] * 260], 24)
    facts = take_images(tmp_path / "film.webm", tmp_path / "images")
    assert len(facts["images"]) == 40


@pytest.fixture
def moving(tmp_path, rng):
    """A film of a smooth picture moving to the left."""
    pytest.importorskip("imageio_ffmpeg")
    wide = Image.fromarray(rng.integers(0, 256, (6, 40, 3), np.uint8)).resize((800, 120))
    shown = [np.array(wide)[:, 4 * k : 4 * k + 160] for k in range(80)]
    write_video(tmp_path / "film.webm", shown, 24)
    return tmp_path / "film.webm"


def taken(film, tmp_path):
    images = take_images(film, tmp_path / film.stem)["images"]
    return [
        read_rgba(tmp_path / film.stem / frame["name"])[..., :3].astype(float) for frame in images
    ]


def test_pixels_of_a_film_become_square(moving, tmp_path):
    film = remade(moving, "narrow.mkv", ["-vf", "scale=120:120,setsar=4/3", "-f", "matroska"])
    assert {image.shape for image in taken(film, tmp_path)} == {(120, 160, 3)}


def test_a_frame_is_of_one_moment(moving, tmp_path):
    """A film whose lines alternate between two moments is deinterlaced, whether it states this or
    not.
    """
    woven = ["-vf", "tinterlace=interleave_top", "-c:v", "libx264", "-f", "matroska"]
    rough = [
        np.mean([np.abs(np.diff(image, 2, 0)).mean() for image in taken(film, tmp_path)])
        for film in (moving, remade(moving, "woven.mkv", woven))
    ]
    assert rough[1] < 1.5 * rough[0]
