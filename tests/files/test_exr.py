from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from support.refused import refusing
from support.scenes import write_ball_scene

from pp_cl.errors import UserError
from pp_cl.files.exr import write_exr
from pp_cl.files.image import image_size, read_rgba
from pp_cl.files.rendered_view import RenderedView
from pp_cl.files.srgb import srgb_to_linear
from pp_cl.scene.load import load_scene


@pytest.fixture
def shown(rng):
    alpha = rng.random((9, 4)).astype(np.float32)
    alpha[0, 0] = 0
    depth = np.where(alpha > 0, 4 * alpha, np.inf).astype(np.float32)
    colour = np.maximum(rng.random((9, 4, 3)), 1 - alpha[..., None]).astype(np.float32)
    features = rng.normal(size=(9, 4, 16)).astype(np.float32)
    return RenderedView(colour, alpha, depth, depth + 1, features)


def test_all_channels_come_back(shown, tmp_path):
    write_exr(tmp_path / "a.exr", shown.channels())
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    there = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    expected = {f"feature.{i:02d}": shown.features[..., i] for i in range(16)}
    expected |= {"A": shown.alpha, "Z": shown.median_depth, "mean.Z": shown.depth}
    assert there.keys() == {*expected, *"RGB"}
    for name, array in expected.items():
        assert there[name].pixels.dtype == np.float32
        np.testing.assert_array_equal(there[name].pixels, array)
    assert np.isinf(there["Z"].pixels[0, 0]) and there["R"].pixels[0, 0] == 0


def test_a_place_that_cannot_be_written_is_one_line(shown, tmp_path):
    with pytest.raises(UserError, match="a.exr: cannot be written"):
        write_exr(tmp_path / "missing" / "a.exr", shown.channels())


WIDTH, HEIGHT = 13, 9


def srgb(linear):
    """The transfer function of IEC 61966-2-1, written out, rounded to 8 bits."""
    linear = np.clip(np.asarray(linear, np.float64), 0, 1)
    low, high = 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
    return np.rint(255 * np.where(linear <= 0.0031308, low, high))


def stored(path, channels, data=None, display=None, tiled=False):
    """Write float16 or float32 channels; data, display: the windows as ((x0, y0), (x1, y1))."""
    kind = OpenEXR.tiledimage if tiled else OpenEXR.scanlineimage
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": kind}
    if tiled:
        header["tiles"] = OpenEXR.TileDescription()
        header["tiles"].xSize = header["tiles"].ySize = 8
    for name, window in (("dataWindow", data), ("displayWindow", display)):
        if window is not None:
            header[name] = tuple(np.array(corner, np.int32) for corner in window)
    OpenEXR.File(header, channels).write(str(path))


def colours(rng, dtype, alpha):
    """({channel: plane}, expected (H, W, 4) of 8 bits); light is HDR, with some pixels above 1."""
    light = rng.uniform(0, 1.4, (HEIGHT, WIDTH, 3)).astype(dtype)
    share = rng.uniform(0.2, 1, (HEIGHT, WIDTH)).astype(dtype) if alpha else None
    premultiplied = light * share[..., None] if alpha else light
    channels = {name: np.ascontiguousarray(premultiplied[..., i]) for i, name in enumerate("RGB")}
    if alpha:
        channels["A"] = share
    straight = premultiplied.astype(float) / (share[..., None].astype(float) if alpha else 1)
    opaque = np.full((HEIGHT, WIDTH), 255.0)
    return channels, np.dstack([srgb(straight), np.rint(255 * share) if alpha else opaque])


@pytest.mark.parametrize("tiled", [False, True], ids=["scanline", "tiled"])
@pytest.mark.parametrize("alpha", [False, True], ids=["opaque", "alpha"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_every_kind_is_read(tmp_path, rng, dtype, alpha, tiled):
    channels, expected = colours(rng, dtype, alpha)
    stored(tmp_path / "a.exr", channels, tiled=tiled)
    assert image_size(tmp_path / "a.exr") == (WIDTH, HEIGHT)
    rgba = read_rgba(tmp_path / "a.exr")
    assert rgba.dtype == np.uint8 and np.abs(rgba - expected).max() <= 1


@pytest.mark.parametrize("shift", [(0, 0), (4, 3), (-4, 2), (20, 20), (-100, 0)])
def test_windows_that_differ(tmp_path, rng, shift):
    channels, expected = colours(rng, np.float32, True)
    low = np.array(shift) + [5, 6]
    data = (low, low + [WIDTH - 1, HEIGHT - 1])
    stored(tmp_path / "a.exr", channels, data, ((5, 6), (5 + 19, 6 + 11)))
    assert image_size(tmp_path / "a.exr") == (20, 12)
    canvas = np.zeros((140, 300, 4))
    canvas[40 + shift[1] :, 120 + shift[0] :][:HEIGHT, :WIDTH] = expected
    rgba = read_rgba(tmp_path / "a.exr")
    wanted = canvas[40:52, 120:140]
    assert np.abs(rgba[..., 3] - wanted[..., 3]).max() <= 1
    there = wanted[..., 3] > 0
    assert np.abs(rgba[there] - wanted[there]).max(initial=0) <= 1
    assert not rgba[~there][:, 3].any()


def test_gray_and_one_layer(tmp_path, rng):
    plane = rng.uniform(0, 1, (600, 3)).astype(np.float32)
    stored(tmp_path / "gray.exr", {"Y": plane})
    assert np.abs(read_rgba(tmp_path / "gray.exr")[..., 1] - srgb(plane)).max() <= 1
    layer = {f"Combined.{name}": plane for name in "RGBA"} | {"Depth.Z": plane}
    stored(tmp_path / "layer.exr", layer)
    assert np.abs(read_rgba(tmp_path / "layer.exr")[..., 3] - 255 * plane).max() <= 1


PLANE = np.ones((HEIGHT, WIDTH), np.float32)
NAN = np.where(np.arange(WIDTH) == 3, np.nan, PLANE).astype(np.float32)
BAD_IMAGES = {
    "no colours": ({"Z": PLANE}, "no images among its channels"),
    "two layers": ({f"{a}.{c}": PLANE for a in "ab" for c in "RGB"}, "several images"),
    "NaN": (dict.fromkeys("RGB", NAN), "9 pixels are NaN or infinite"),
    "infinite": (dict.fromkeys("RGBA", PLANE * np.inf), "117 pixels"),
}


@pytest.mark.parametrize("case", BAD_IMAGES)
def test_images_that_are_refused(tmp_path, case):
    channels, words = BAD_IMAGES[case]
    stored(tmp_path / "a.exr", {name: plane.copy() for name, plane in channels.items()})
    with refusing(tmp_path / "a.exr", words):
        read_rgba(tmp_path / "a.exr")


def test_parts_sizes_and_damage(tmp_path, capfd, monkeypatch):
    planes = {name: PLANE.copy() for name in "RGB"}
    parts = [OpenEXR.Part({"name": n, "type": OpenEXR.scanlineimage}, planes) for n in "ab"]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    stored(tmp_path / "whole.exr", planes)
    (tmp_path / "cut.exr").write_bytes((tmp_path / "whole.exr").read_bytes()[:-40])
    for name, words in (("parts", "2 parts"), ("cut", "cannot be read as OpenEXR")):
        with pytest.raises(UserError, match=words):
            read_rgba(tmp_path / f"{name}.exr")
    assert capfd.readouterr() == ("", "")
    monkeypatch.setattr("pp_cl.files.exr.MOST_PIXELS", 100)
    for read in (read_rgba, image_size):
        with refusing("13x9 pixels"):
            read(tmp_path / "whole.exr")


def test_it_may_be_an_image_of_a_scene(tmp_path):
    file = Path(write_ball_scene(tmp_path, views=4, size=24)) / "train" / "r_0.png"
    image = read_rgba(file)
    rgba = image.astype(np.float32) / 255
    light = np.dstack([srgb_to_linear(rgba[..., :3]) * rgba[..., 3:], rgba[..., 3]])
    planes = {name: np.ascontiguousarray(light[..., i]) for i, name in enumerate("RGBA")}
    write_exr(file.with_suffix(".exr"), planes)
    file.unlink()
    converted = load_scene(tmp_path).splits["train"][0].image
    assert np.abs(converted.astype(int) - image * (image[..., 3:] > 0)).max() <= 1
