import numpy as np
import pytest
from support.same_scene import held_out
from support.scenes import ball_image, ring_cameras

from pp_cl.engine.views import View
from pp_cl.scene.load import load_scene
from pp_cl.scene.silhouette import within_silhouettes
from tools.convert_scene import convert

SIDE = 300


@pytest.fixture(scope="module")
def views():
    return [
        View(f"{i:02d}.png", camera, ball_image(camera))
        for i, camera in enumerate(ring_cameras(15, SIDE))
    ]


def opaque(view):
    image = view.image.copy()
    image[view.image[..., 3] == 0, :3] = (200, 30, 30)
    image[..., 3] = 255
    return View(view.name, view.stored_camera, image)


def test_what_is_not_ignored_is_right(dev, views):
    bare = [opaque(view) for view in views[::3]]
    masked = [view for i, view in enumerate(views) if i % 3]
    for view, true in zip(within_silhouettes(dev, masked, bare), views[::3], strict=True):
        known = ~view.ignored
        assert np.array_equal(view.image[known, 3], true.image[known, 3])
        shown = known & (true.image[..., 3] == 255)
        assert np.array_equal(view.image[shown], true.image[shown])
        assert view.ignored.mean() < 0.12 and shown.mean() > 0.7 * (true.image[..., 3] > 0).mean()
        assert not view.image[view.ignored].any()


@pytest.mark.parametrize("form", ("colmap", "llff"))
def test_views_whose_masks_are_gone_are_used(dev, views, tmp_path, form):
    convert(held_out(views), tmp_path, form)
    whole = load_scene(tmp_path, dev=dev).splits["train"]
    for file in sorted((tmp_path / "masks").iterdir())[2::4]:
        file.unlink()
    with pytest.warns(
        UserWarning, match=r"train: views without a mask .* \(images/000002\.png"
    ) as warned:
        used = load_scene(tmp_path, dev=dev).splits["train"]
    assert len(warned) == 1 and [view.name for view in used] == [view.name for view in whole]
    gone = [view for view in used if view.ignored is not None]
    assert (
        len(gone) == len(used) - sum(view.is_masked and view.ignored is None for view in used) > 1
    )
