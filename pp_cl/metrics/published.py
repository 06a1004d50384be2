"""Published results for benchmark scenes, which an evaluation shows next to its own: Tables 1 to 7
of the PlenopticPoints supplemental, stored in published.json.
"""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pp_cl.engine.camera import Camera

FILE = Path(__file__).with_name("published.json")
SYNTHETIC_SIZE, SYNTHETIC_FOCAL = 800, 1111.11  # pixels, for the stored images of all eight scenes
SYNTHETIC_VIEWS = 200  # in the test split
# the four sequences of Tables 1 to 3
CO3D_SEQUENCES = {
    "590_88941_178115": "car",
    "250_26779_55023": "hydrant",
    "618_100125_200129": "plant",
    "34_1479_4753": "teddybear",
}
METRICS = ("psnr", "ssim", "lpips")


@cache
def tables() -> dict[str, Any]:
    """The content of published.json. synthetic (Tables 5 to 7) and co3d (1 to 3): {"scenes": names,
    "methods": {name: {"psnr": [...], "ssim": [...], "lpips": [...] by scene or null, "mean":
    {...}}}}; lpips_net: LPIPS's network if it is not VGG16. shape (Table 4): rows by scene.
    """
    return json.loads(FILE.read_text("utf-8"))


def published_rows(scene_name: str, cameras: Sequence[Camera]) -> dict[str, dict[str, float]]:
    """{method: {"psnr", "ssim", "lpips"}} for a published scene, the highest PSNR first; {} for
    other scenes. LPIPS by another network is lpips_alex. NeRF-synthetic's scenes are recognised by
    their names and the cameras of their stored images, CO3D's by the names of their sequences.
    """
    if scene_name in CO3D_SEQUENCES:
        return _rows(tables()["co3d"], CO3D_SEQUENCES[scene_name])
    synthetic = all(
        c.width == c.height == SYNTHETIC_SIZE and abs(c.fx - SYNTHETIC_FOCAL) < 0.01
        for c in cameras
    )
    known = tables()["synthetic"]
    return _rows(known, scene_name) if synthetic and scene_name in known["scenes"] else {}


def differences(
    scene_name: str, cameras: Sequence[Camera], downscale: float, split: str = "test"
) -> str:
    """How a measurement of a published scene differs from the published measurements; "" if it does
    not. cameras: cameras of the measured views' stored images.
    """
    if scene_name in CO3D_SEQUENCES:
        conditions = [f"split {split}"] * (split != "test")
        conditions += [f"images reduced {downscale:g} times"] * (downscale > 1)
        return f"here: {', '.join(conditions)}" if conditions else ""
    views = "{} {} views of {}x{} pixels".format
    published = views(SYNTHETIC_VIEWS, "test", SYNTHETIC_SIZE, SYNTHETIC_SIZE)
    here = views(len(cameras), split, *[int(SYNTHETIC_SIZE / downscale)] * 2)
    return "" if here == published else f"published: {published}; here: {here}"


def _rows(table, scene):
    column, rows = table["scenes"].index(scene), {}
    for name, method in table["methods"].items():
        row = {metric: method[metric][column] for metric in METRICS if method[metric]}
        if "lpips_net" in method:
            row[f"lpips_{method['lpips_net']}"] = row.pop("lpips")
        rows[name] = row
    return dict(sorted(rows.items(), key=lambda item: -item[1]["psnr"]))
