import os
import zlib

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms
from support.profile import SRGB, display_p3, in_srgb
from support.refused import refusing

from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import (
    ORIENTATION,
    exif_turns,
    image_paths,
    image_size,
    read_mask,
    read_rgba,
    to_8bit,
    write_png,
)
from pp_cl.files.srgb import linear_to_srgb


@pytest.fixture
def rgba(rng):
    return rng.integers(0, 256, (5, 7, 4), np.uint8)


def test_modes_become_rgba(tmp_path, rgba):
    opaque = rgba.copy()
    opaque[..., 3] = 255
    gray = np.repeat(rgba[..., :1], 4, -1)
    gray[..., 3] = 255
    gray_alpha = np.concatenate([gray[..., :3], rgba[..., 3:]], -1)
    bilevel = np.where(gray > 127, 255, 0).astype(np.uint8)
    bilevel[..., 3] = 255
    palette = Image.fromarray(np.arange(35, dtype=np.uint8).reshape(5, 7))
    palette.putpalette(rgba[..., :3].tobytes())
    keyed = opaque.copy()
    keyed[2, 3, 3] = 0
    for name, image, options, expected in (
        ("rgba", Image.fromarray(rgba), {}, rgba),
        ("rgb", Image.fromarray(rgba[..., :3]), {}, opaque),
        ("gray", Image.fromarray(rgba[..., 0]), {}, gray),
        ("gray_alpha", Image.fromarray(gray_alpha[..., 2:], "LA"), {}, gray_alpha),
        ("bilevel", Image.fromarray(rgba[..., 0] > 127), {}, bilevel),
        ("palette", palette, {}, opaque),
        ("palette_with_transparency", palette, {"transparency": 2 * 7 + 3}, keyed),
    ):
        path = tmp_path / f"{name}.png"
        image.save(path, **options)
        assert image_size(path) == (7, 5), name
        result = read_rgba(path)
        assert result.dtype == np.uint8 and np.array_equal(result, expected), name


def test_masks_of_other_programs(tmp_path, rgba):
    gray, path = rgba[..., 0], tmp_path / "a.png"
    for image in (gray, np.dstack([gray] * 3), np.dstack([rgba[..., :3], gray])):
        Image.fromarray(image).save(path)
        assert np.array_equal(read_mask(path), gray)
    labels = Image.fromarray((gray > 127).astype(np.uint8))
    labels.save(path)
    with pytest.warns(UserWarning, match="masks of 0 and 1 are read as 0 and 255"):
        assert np.array_equal(read_mask(path), np.where(gray > 127, 255, 0))
    Image.fromarray(np.ones_like(gray)).save(tmp_path / "a.jpg")
    with pytest.raises(UserError, match=r"a\.jpg: .* 1 .* write 255"):
        read_mask(tmp_path / "a.jpg")
    labels.putpalette([0, 0, 0, 128, 0, 0])  # as object trackers write them
    labels.save(path)
    with pytest.raises(UserError, match=r"a\.png: .*colours.* white where the object is"):
        read_mask(path)
    Image.fromarray(np.zeros_like(gray)).save(path)
    assert not read_mask(path).any()


def test_colour_noise_and_coloured_rims_are_no_colours(tmp_path, rng):
    """JPEG subsamples colours (NeRD's captures, up to 36 levels) and programs blend rims (DTU in
    NeuS's form); but an image with colours in a quarter of its pixels is no mask.
    """
    y, x = np.mgrid[:300, :400]
    gray = np.where(np.hypot(y - 150, x - 200) < 100, 255, 0)
    rim = np.abs(np.hypot(y - 150, x - 200) - 100) < 1
    noisy = np.dstack([gray] * 3) + rng.integers(-40, 41, (300, 400, 3))
    noisy[rim] = (250, 120, 60)
    Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(tmp_path / "a.png")
    assert (read_mask(tmp_path / "a.png") > 127)[~rim].mean() == (gray > 127)[~rim].mean()
    Image.open(tmp_path / "a.png").save(tmp_path / "a.jpg", quality=75)
    assert ((read_mask(tmp_path / "a.jpg") > 127) == (gray > 127))[~rim].mean() > 0.99
    noisy[gray > 127] = (255, 255, 200)
    Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(UserError, match="has colours"):
        read_mask(tmp_path / "a.png")


def test_sixteen_bits_become_eight(tmp_path, rgba):
    Image.fromarray(rgba[..., 0].astype(np.uint16) * 257 + 128).save(tmp_path / "gray.png")
    with pytest.warns(UserWarning, match="16 bits a channel are read as 8"):
        assert np.array_equal(read_rgba(tmp_path / "gray.png")[..., 1], rgba[..., 0])
    Image.fromarray(rgba[..., 0].astype(np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(Unusable, match=r"float\.tif: not 8 or 16 bits a channel"):
        read_rgba(tmp_path / "float.tif")


def test_colours_of_other_spaces_become_srgb(tmp_path):
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    image = Image.new("RGB", (40, 30), (200, 90, 60))
    image.save(tmp_path / "p3.png", icc_profile=display_p3())
    with pytest.warns(UserWarning, match="a colour profile of their own are read as sRGB"):
        rgb = read_rgba(tmp_path / "p3.png")[..., :3]
    assert np.abs(rgb - in_srgb((200, 90, 60))).max() <= 1
    image.save(tmp_path / "srgb.jpg", icc_profile=own, quality=95, subsampling=0)
    assert np.abs(read_rgba(tmp_path / "srgb.jpg")[..., :3].astype(int) - (200, 90, 60)).max() <= 2
    image.save(tmp_path / "linear.png", icc_profile=display_p3(b"Linear sRGB", SRGB, 1.0))
    light = 255 * linear_to_srgb(np.array([200, 90, 60]) / 255)  # its name is not what counts
    assert np.abs(read_rgba(tmp_path / "linear.png")[..., :3] - light).max() <= 1
    image.convert("CMYK").save(tmp_path / "inks.jpg", quality=95)
    assert np.abs(read_rgba(tmp_path / "inks.jpg")[..., :3].astype(int) - (200, 90, 60)).max() <= 4
    half = np.tile(np.uint8([100, 45, 30, 128]), (30, 40, 1))
    associated = {"photometric": "rgb", "extrasamples": ["assocalpha"]}
    tifffile.imwrite(tmp_path / "multiplied.tif", half, **associated)
    assert np.abs(read_rgba(tmp_path / "multiplied.tif").astype(int) - (200, 90, 60, 128)).max() < 2
    image.save(tmp_path / "broken.png", icc_profile=b"no profile")
    assert (read_rgba(tmp_path / "broken.png")[..., :3] == (200, 90, 60)).all()


def test_a_checksum_that_is_wrong_is_refused(tmp_path):
    """Pixels are smooth, so that the compressed stream stays readable after a changed bit."""
    y, x = np.mgrid[:64, :64]
    image = np.dstack([x * 2, y * 2, x + y, np.full_like(x, 255)]).astype(np.uint8)
    path = tmp_path / "a.png"
    write_png(path, image)
    content = path.read_bytes()
    for place in range(41, len(content) - 16, 3):  # places in the compressed pixels
        changed = bytearray(content)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        with pytest.raises(UserError, match="a.png: cannot be read as PNG, JPEG, WEBP"):
            read_rgba(path)
        assert image_size(path) == (64, 64)


@pytest.mark.unix
@pytest.mark.parametrize("read", (read_rgba, image_size))
def test_not_an_image(tmp_path, read):
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.png").touch()
    for name in ("pipe.png", "pipe.exr"):
        os.mkfifo(tmp_path / name)
    Image.new("RGB", (5, 7)).save(tmp_path / "a.gif")
    write_png(tmp_path / "huge.png", np.zeros((5, 7)))
    whole = (tmp_path / "huge.png").read_bytes()
    head = b"IHDR" + bytes([0, 0, 255, 255] * 2) + whole[24:29]
    head += zlib.crc32(head).to_bytes(4, "big")
    (tmp_path / "huge.png").write_bytes(whole[:12] + head + whole[33:])
    with refusing(tmp_path / "a.gif", "is no PNG, JPEG, WEBP, ", "; convert it"):
        read(tmp_path / "a.gif")
    with refusing(tmp_path / "huge.png", " pixels; reduce the image"):
        read(tmp_path / "huge.png")
    for path in (*sorted(tmp_path.iterdir()), tmp_path, tmp_path / "none.png"):
        with refusing(path):
            read(path)


@pytest.mark.parametrize("shape", ((5, 7), (5, 7, 3), (5, 7, 4)))
def test_written_image_comes_back(tmp_path, rng, shape):
    image = rng.random(shape)
    write_png(tmp_path / "float.png", image)
    stored = np.array(Image.open(tmp_path / "float.png"))
    assert np.array_equal(stored, to_8bit(image))
    write_png(tmp_path / "bytes.png", stored)
    assert np.array_equal(stored, np.array(Image.open(tmp_path / "bytes.png")))


@pytest.mark.parametrize("orientation, size", [(3, (7, 5)), (6, (5, 7))])
def test_a_tiff_is_shown_as_pillow_turns_it(tmp_path, rgba, orientation, size):
    """A camera of the stored pixels of a picture on its side is refused."""
    path, exif = tmp_path / "a.tif", Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(rgba[..., :3]).save(path, exif=exif)
    assert exif_turns(path) == 0 and image_size(path) == size
    turned = np.rot90(rgba[..., :3], 2 if orientation == 3 else -1)
    np.testing.assert_array_equal(read_rgba(path, size)[..., :3], turned)
    if orientation == 6:
        with pytest.raises(Unusable, match="its orientation turns it"):
            read_rgba(path, size[::-1])


def test_to_8bit():
    levels = to_8bit([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 254.4 / 255, 1.0, np.inf])
    assert levels.tolist() == [0, 0, 0, 1, 254, 255, 255]
    with pytest.raises(ValueError, match="NaN"):
        to_8bit([0.5, np.nan])


@pytest.mark.parametrize(
    "names, files",
    [
        (["test/r_0.png", "test/r_1.png"], ["r_0.png", "r_1.png"]),
        (["cam0/0001.png", "cam1/0001.jpg"], ["cam0/0001.png", "cam1/0001.png"]),
        (["test/1.png", "2.png"], ["test/1.png", "2.png"]),
        (["test/1.png", "test/1.jpg"], ["1.png.png", "1.jpg.png"]),
        (["a.jpg", "../../../b.jpg"], ["a.png", "b.png"]),
        (["/data/a.png", "b/c.png"], ["data/a.png", "b/c.png"]),
    ],
)
def test_every_image_has_a_file_of_its_own(names, files):
    assert [str(path) for path in image_paths(names)] == files
