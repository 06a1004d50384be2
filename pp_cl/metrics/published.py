"""Published results for benchmark scenes, which an evaluation puts beside its own."""

from collections.abc import Sequence

from pp_cl.scene.camera import Camera

# PlenopticPoints supplemental, Tables 5 to 7: PSNR, SSIM, LPIPS (VGG) over the 200 test views of
# 800x800.
PLENOPTIC_POINTS = {
    "chair": (35.35, 0.986, 0.016),
    "drums": (25.59, 0.947, 0.050),
    "ficus": (32.68, 0.982, 0.016),
    "hotdog": (37.18, 0.985, 0.022),
    "lego": (33.00, 0.975, 0.026),
    "materials": (29.27, 0.960, 0.041),
    "mic": (35.07, 0.991, 0.007),
    "ship": (28.40, 0.891, 0.125),
}
SYNTHETIC_SIZE, SYNTHETIC_FOCAL = 800, 1111.11  # pixels, of all eight scenes' stored images


def published_row(scene_name: str, cameras: Sequence[Camera]) -> dict[str, dict[str, float]]:
    """{"PlenopticPoints": {"psnr", "ssim", "lpips"}} for a scene of NeRF-synthetic, else {}.

    The scene is recognised by its name together with the cameras of its stored images. The results
    are means over the test split at 800x800 pixels, whatever the evaluation beside them measures.
    """
    synthetic = all(
        c.width == c.height == SYNTHETIC_SIZE and abs(c.fx - SYNTHETIC_FOCAL) < 0.01
        for c in cameras
    )
    if scene_name not in PLENOPTIC_POINTS or not synthetic:
        return {}
    values = PLENOPTIC_POINTS[scene_name]
    return {"PlenopticPoints": dict(zip(("psnr", "ssim", "lpips"), values, strict=True))}
