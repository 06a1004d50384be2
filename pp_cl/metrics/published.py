"""Published results for benchmark scenes, which an evaluation puts beside its own: Tables 1 to 7 of
the PlenopticPoints supplemental, in published.json.
"""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pp_cl.engine.camera import Camera

FILE = Path(__file__).with_name("published.json")
SYNTHETIC_SIZE, SYNTHETIC_FOCAL = 800, 1111.11  # pixels, of all eight scenes' stored images
SYNTHETIC_VIEWS = 200  # of the test split
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
    """published.json. synthetic (Tables 5 to 7) and co3d (1 to 3): {"scenes": names, "methods":
    {name: {"psnr": [...], "ssim": [...], "lpips": [...] of the scenes or null, "mean": {...}}}};
    lpips_net: of LPIPS where it is not VGG16. shape (Table 4): rows by scene.
    """
    return json.loads(FILE.read_text("utf-8"))


def published_rows(scene_name: str, cameras: Sequence[Camera]) -> dict[str, dict[str, float]]:
    """{method: {"psnr", "ssim", "lpips"}} of a published scene, by PSNR from the best on, else {}.
    LPIPS of another net is lpips_alex. A scene of NeRF-synthetic is recognised by its name and the
    cameras of its stored images, one of CO3D by the name of its sequence.
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
    scene_name: str, cameras: Sequence[Camera], downscale: int, split: str = "test"
) -> str:
    """How a measurement of a published scene differs from the published ones; "" if it does not.
    cameras: of the stored images of the views measured.
    """
    if scene_name in CO3D_SEQUENCES:
        said = [f"split {split}"] * (split != "test")
        said += [f"images reduced {downscale} times"] * (downscale > 1)
        return f"here: {', '.join(said)}" if said else ""
    views = "{} {} views of {}x{} pixels".format
    published = views(SYNTHETIC_VIEWS, "test", SYNTHETIC_SIZE, SYNTHETIC_SIZE)
    here = views(len(cameras), split, *[SYNTHETIC_SIZE // downscale] * 2)
    return "" if here == published else f"published: {published}; here: {here}"


def _rows(table, scene):
    column, rows = table["scenes"].index(scene), {}
    for name, method in table["methods"].items():
        row = {metric: method[metric][column] for metric in METRICS if method[metric]}
        if "lpips_net" in method:
            row[f"lpips_{method['lpips_net']}"] = row.pop("lpips")
        rows[name] = row
    return dict(sorted(rows.items(), key=lambda item: -item[1]["psnr"]))
