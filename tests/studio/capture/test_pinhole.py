import numpy as np
import pytest
from PIL import Image

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lens import LensDistortion, undistort
from pp_studio.capture.frames import undistorted_mask, write_images
from pp_studio.capture.poses import undistort_model

colmap = pytest.importorskip("pycolmap")
CAMERA = Camera(np.eye(3, 4), 80.0, 80.0, 48.0, 32.0, 96, 64)
LENS = LensDistortion(-0.2)


def taken(*names, lens=LENS):
    return [ImageFile(f"images/{name}", CAMERA, lens=lens) for name in names]


def test_images_are_written_once_in_the_format_of_the_photographs(dev, tmp_path, rng):
    frames, images = tmp_path / "frames", tmp_path / "images"
    frames.mkdir()
    colours = np.uint8(rng.integers(0, 256, (8, 12, 3))).repeat(8, 0).repeat(8, 1)
    alpha = np.dstack([colours, colours[..., :1]])
    Image.fromarray(colours).save(frames / "a.jpg", quality=95)
    Image.fromarray(colours).save(frames / "b.png")
    Image.fromarray(alpha).save(frames / "c.png")
    image_files = taken("a.jpg", "b.png", "c.png")
    assert write_images(dev, frames, images, image_files) == 3
    for name, mode in (("a.jpg", "RGB"), ("b.png", "RGB"), ("c.png", "RGBA")):
        with Image.open(images / name) as image:
            assert image.mode == mode and image.size == (96, 64)
            assert name != "a.jpg" or {layer[1:3] for layer in image.layer} == {(1, 1)}  # 4:4:4
        straight = undistort(dev, read_rgba(frames / name), CAMERA, LENS)
        off = np.abs(read_rgba(images / name).astype(int) - straight)
        assert off.max() == 0 if name != "a.jpg" else off.mean() < 3
    (images / "b.png").unlink()
    before = (images / "a.jpg").stat().st_mtime_ns
    assert write_images(dev, frames, images, image_files) == 1, "those that are there stay"
    assert (images / "b.png").is_file() and (images / "a.jpg").stat().st_mtime_ns == before


def test_a_lens_that_folds_the_image_is_refused(dev, tmp_path):
    with pytest.raises(UserError, match="a.png: the lens that was found folds"):
        write_images(dev, tmp_path, tmp_path / "images", taken("a.png", lens=LensDistortion(-2.0)))
    assert not (tmp_path / "images").exists()


def test_masks_move_as_their_photographs_do(dev):
    mask = np.zeros((64, 96), np.uint8)
    mask[10:50, 12:70] = 255
    expected = undistort(dev, np.dstack([mask] * 3 + [mask * 0 + 255]), CAMERA, LENS)[..., 0]
    [bent], [straight] = taken("a.png"), taken("a.png", lens=LensDistortion())
    assert np.abs(undistorted_mask(dev, mask, bent).astype(int) - expected).max() <= 1
    assert np.array_equal(undistorted_mask(dev, mask, straight), mask)


def seen(model, image):
    return enumerate(model.image(image).points2D)


def test_points_of_a_model_stay_where_cameras_see_them():
    colmap.set_random_seed(0)
    options = colmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=4, num_points3D=50)
    options.camera_model_id = colmap.CameraModelId.SIMPLE_RADIAL
    options.camera_width, options.camera_height = 400, 300
    options.camera_params = [320, 200, 150, 0.08]
    model = colmap.synthesize_dataset(options)
    places = {(i, k): p.xy.copy() for i in model.images for k, p in seen(model, i)}
    undistort_model(model)
    moved = [abs(p.xy - places[i, k]).max() for i in model.images for k, p in seen(model, i)]
    assert max(moved) > 3
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-9
    assert {str(camera.model) for camera in model.cameras.values()} == {"CameraModelId.PINHOLE"}
