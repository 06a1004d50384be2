import json
import warnings

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter
from support.runs import arguments
from support.scenes import ball_image, ring_cameras, write_ball_scene
from support.transforms_scenes import write_scene

from pp_cl.cli import main
from pp_cl.config import configure, preset
from pp_cl.drivers import open_device
from pp_cl.engine.views import MASK_THRESHOLD
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba, write_png
from pp_cl.run import load
from pp_cl.scene.agreement import disagreements
from pp_cl.scene.hull import agreeing, build_grid
from pp_cl.scene.listing import scene_box
from pp_cl.scene.load import load_scene, open_scene
from pp_cl.scene.masks import cut_out
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.settings import SceneConfig

TOLERANCE = 10.0


def disc(size=60, radius=20.0, soft=0.0):
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    alpha = (np.hypot(x, y) < radius).astype(float)
    return gaussian_filter(alpha, soft) if soft else alpha


def over(alpha, colour, background):
    """(H, W, 4) uint8, opaque: a colour in [0, 1], composited over another by alpha."""
    image = alpha[..., None] * np.array(colour) + (1 - alpha[..., None]) * np.array(background)
    return np.dstack([np.rint(255 * image), np.full(alpha.shape, 255)]).astype(np.uint8)


@pytest.mark.parametrize("background", [(1, 1, 1), (0, 0, 0), (0.1, 0.8, 0.2), (0.4, 0.4, 0.45)])
def test_a_uniform_background_is_cut_out(rng, background):
    alpha = disc()
    image = over(alpha, (0.7, 0.2, 0.25), background).astype(float)
    image[..., :3] += rng.normal(0, 2, image[..., :3].shape) + np.linspace(-3, 3, 60)[:, None]
    image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    rgba = cut_out(image, "a.png", TOLERANCE)
    assert ((rgba[..., 3] > 127) == (alpha > 0.5)).all()
    assert (rgba[..., 3][alpha == 1] > 220).all(), "the noise of the colours is that of the edge"
    inside = disc(radius=17) == 1
    assert np.abs(rgba[inside].astype(int) - image[inside]).max() <= 1


def test_soft_edges_lose_the_background(rng):
    """A half transparent pixel gets the object's colour, not a mixture with the screen."""
    alpha, colour = disc(soft=1.2), np.array([0.8, 0.3, 0.2])
    rgba = cut_out(over(alpha, colour, (0.0, 1.0, 0.0)), "a.png", TOLERANCE) / 255
    edge = (rgba[..., 3] > 0.3) & (rgba[..., 3] < 1)
    assert edge.sum() > 10
    mixed = (alpha[..., None] * colour + (1 - alpha[..., None]) * [0, 1, 0])[edge]
    error, before = (np.abs(c - colour).mean() for c in (rgba[edge][:, :3], mixed))
    assert error < 0.7 * before


def test_spots_of_the_backgrounds_colour_stay():
    """Spots that the object encloses count as the object; a bay open to the border does not."""
    alpha = disc()
    image = over(alpha, (0.6, 0.1, 0.1), (1, 1, 1))
    image[26:34, 26:34, :3] = 255
    image[28:32, :30, :3] = 255
    assert (cut_out(image, "a.png", TOLERANCE)[26:34, 26:34, 3] == 0).all()
    image = over(alpha, (0.6, 0.1, 0.1), (1, 1, 1))
    image[26:34, 26:34, :3] = 255
    assert (cut_out(image, "a.png", TOLERANCE)[26:34, 26:34, 3] == 255).all()
    assert (cut_out(image, "a.png", TOLERANCE, with_holes=True)[26:34, 26:34, 3] == 0).all()


def test_a_border_of_many_colours_is_refused(rng):
    image = rng.integers(0, 256, (40, 40, 4), np.uint8)
    with pytest.raises(UserError, match=r"a\.png: only \d+% of its border.*--masks FOLDER"):
        cut_out(image, "a.png", TOLERANCE)


def test_an_object_at_the_border_does_not_decide():
    """The object covers less than half of the border, so the other colour is the background."""
    image = over(np.zeros((40, 40)), (0, 0, 0), (1, 1, 1))
    image[:25, :30, :3] = (200, 30, 30)
    alpha = cut_out(image, "a.png", TOLERANCE)[..., 3]
    assert (alpha[:25, :30] == 255).all() and (alpha[25:] == 0).all()


@pytest.mark.parametrize("named", ["{stem}.png", "{name}.png", "{stem}.jpg"])
def test_a_folder_of_masks(tmp_path, rng, named):
    (tmp_path / "scene").mkdir()
    write_scene(tmp_path / "scene")
    masks = tmp_path / "masks"
    masks.mkdir()
    expected = {}
    for i in range(3):
        mask = np.kron(rng.integers(0, 2, (9, 12)), np.ones((2, 2))).astype(np.uint8) * 255
        file = masks / named.format(stem=f"train_{i}", name=f"train_{i}.png")
        Image.fromarray(mask).save(file, quality=100)
        expected[f"train_{i}.png"] = mask
    views = load_scene(tmp_path / "scene", masks=SceneConfig(masks=str(masks))).splits["train"]
    for view in views:
        assert np.abs(view.image[..., 3].astype(int) - expected[view.name]).max() <= 8
        stored = read_rgba(tmp_path / "scene" / view.name)
        assert (view.image[..., :3] == stored[..., :3]).all()


def test_a_folder_of_masks_is_one_like_that_of_the_scene(tmp_path):
    """Masks lie in the same tree as the images, or are found by number if names are unique."""
    scene, masks, frames = tmp_path / "scene", tmp_path / "masks", []
    for i, camera in enumerate(ring_cameras(10, 24)):
        image = f"{'ab'[i % 2]}/{i // 2}.png" if i < 8 else f"c/{i:06d}.png"
        mask = masks / (image if i < 9 else "9.png")
        for file, pixels in ((scene / image, slice(3)), (mask, 3)):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_png(file, ball_image(camera)[..., pixels])
        frames.append({"file_path": image, **frame_keys(camera)})
    (scene / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    rule = SceneConfig(masks=str(masks))
    views = load_scene(scene, masks=rule).splits["train"]
    assert len(views) == 10 and all(view.is_masked and view.has_mask for view in views)


@pytest.mark.parametrize(
    "source, opaque", [("given", False), ("alpha", False), ("none", True), ("box", True)]
)
def test_alpha_is_taken_or_left(tmp_path, source, opaque):
    write_scene(tmp_path)
    for view in load_scene(tmp_path, masks=SceneConfig(mask_from=source)).splits["train"]:
        assert (view.image[..., 3] == 255).all() == opaque


def opaque_ball(folder, background=(255, 255, 255)):
    write_ball_scene(folder, views=10, size=40)
    for file in folder.rglob("*.png"):
        rgba = read_rgba(file)
        rgba[rgba[..., 3] == 0] = (*background, 255)
        write_png(file, rgba[..., :3])
    return str(folder)


def test_a_ball_on_white_has_the_hull_of_its_masks(dev, tmp_path):
    opaque_ball(tmp_path / "white")
    write_ball_scene(tmp_path / "masked", views=10, size=40)
    cut = load_scene(tmp_path / "white", masks=SceneConfig(mask_from="color")).splits["train"]
    masked = load_scene(tmp_path / "masked").splits["train"]
    for a, b in zip(cut, masked, strict=True):
        masks = [view.image[..., 3] > MASK_THRESHOLD for view in (a, b)]
        assert (masks[0] != masks[1]).mean() < 0.01
    hulls = [build_grid(dev, views, 2000) for views in (cut, masked)]
    assert hulls[0].grid.voxel_size == pytest.approx(hulls[1].grid.voxel_size, rel=0.02)


def test_without_masks_points_fill_what_all_cameras_see(dev, tmp_path):
    """Two rings of cameras: the middle is in every image, and the box ends beyond the view of all
    cameras.
    """
    scene = opaque_ball(tmp_path / "white")
    config = configure(preset("tiny"), scene)
    with pytest.warns(UserWarning, match="no image has a mask.*--mask-from color"):
        views = open_scene(dev, config, ("train",)).splits["train"]
    hull = build_grid(dev, views, 3000)
    box = hull.grid.box
    assert (box[0] < -0.8).all() and (box[1] > 0.8).all() and np.abs(box).max() < 3
    config = configure(preset("tiny"), scene, [("scene.mask_from", "box", "test")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        open_scene(dev, config, ("train",))


def test_a_box_that_is_given():
    """tests/scene/test_hull.py tests that the points lie in it."""
    given = [("scene.box", "1,-1,-0.5,-0.9,0.8,0.5", "test")]
    box = scene_box(configure(preset("tiny"), "demo", given))
    np.testing.assert_array_equal(box, [[-0.9, -1, -0.5], [1, 0.8, 0.5]])
    assert scene_box(configure(preset("tiny"), "demo")) is None


def test_a_mask_for_some_images_only(dev, tmp_path):
    write_ball_scene(tmp_path / "ball", views=6, size=40)
    write_png(tmp_path / "ball/train/r_2.png", read_rgba(tmp_path / "ball/train/r_2.png")[..., :3])
    with pytest.raises(UserError, match=r"train/r_2\.png: has no mask, but others have"):
        load_scene(tmp_path / "ball")
    (tmp_path / "masks").mkdir()
    for i, camera in enumerate(ring_cameras(6, 40)):
        mask = ball_image(camera)[..., 3] if i != 2 else np.full((40, 40), 255, np.uint8)
        write_png(tmp_path / "masks" / f"r_{i}.png", mask)
    rule = SceneConfig(masks=str(tmp_path / "masks"))
    views = load_scene(tmp_path / "ball", masks=rule).splits["train"]
    (tmp_path / "masks/r_2.png").rename(tmp_path / "masks/other.png")
    with pytest.raises(UserError, match=r"train/r_2\.png: has no mask, but others have"):
        load_scene(tmp_path / "ball", masks=rule)
    agreed = agreeing(dev, views)  # a white mask says that the object fills the image
    assert (
        agreed.views == views and disagreements(views, build_grid(dev, views, 1000).grid.box) == []
    )


@pytest.mark.parametrize("sigma", (0, 3))
def test_masks_that_are_half_transparent_are_told(dev, tmp_path, sigma, recwarn):
    """Sharp masks are not reported: their edges do not count."""
    scene = write_ball_scene(tmp_path / "ball", views=6, size=40)
    for file in (tmp_path / "ball").rglob("*.png"):
        rgba = read_rgba(file)
        rgba[..., 3] = gaussian_filter(rgba[..., 3], sigma or 0.5)
        write_png(file, rgba)
    open_scene(dev, configure(preset("tiny"), scene), ("train",))
    messages = [
        str(warning.message) for warning in recwarn if "half transparent" in str(warning.message)
    ]
    assert len(messages) == bool(sigma)


def test_inverted_masks_are_told(dev, tmp_path):
    scene = write_ball_scene(tmp_path / "ball", views=6, size=40)
    for file in (tmp_path / "ball").rglob("*.png"):
        rgba = read_rgba(file)
        rgba[..., 3] = 255 - rgba[..., 3]
        write_png(file, rgba)
    with pytest.warns(UserWarning, match="as if they were inverted.* white on the object"):
        open_scene(dev, configure(preset("tiny"), scene), ("train",))


def test_the_choice_is_kept_with_the_run(tmp_path, monkeypatch):
    """A relative folder of masks is stored as an absolute path."""
    scene = opaque_ball(tmp_path / "white", (20, 220, 40))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "masks").mkdir()
    for i, camera in enumerate(ring_cameras(10, 40)):
        write_png(tmp_path / "masks" / f"r_{i}.png", ball_image(camera)[..., 3])
    words = arguments(scene, "run", 1, train__iterations=1, points__count=300)
    assert main([*words, "--masks", "masks"]) == 0
    monkeypatch.chdir("/")
    stored = json.loads((tmp_path / "run" / "config.json").read_text())["scene"]
    assert stored["masks"] == str(tmp_path / "masks")
    assert load(tmp_path / "run", open_device()).scene("train").splits["train"][3].has_mask
