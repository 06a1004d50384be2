"""Published results equal those in the supplemental, and are shown only for the scenes that they
were measured on.
"""

import numpy as np
import pytest

from pp_cl.engine.camera import Camera
from pp_cl.metrics.published import CO3D_SEQUENCES, METRICS, differences, published_rows, tables

OURS = {"psnr": 33.00, "ssim": 0.975, "lpips": 0.026}
PRINTED = {"psnr": 0.0051, "ssim": 0.00051, "lpips": 0.00051}  # half a unit of the last digit


def cameras(focal=1111.111, size=800, count=2):
    return [Camera(np.eye(3, 4), focal, focal, size / 2, size / 2, size, size)] * count


@pytest.mark.parametrize("table", ["synthetic", "co3d"])
def test_every_mean_that_is_printed_is_the_mean_of_its_row(table):
    """It shows that no number was mistaken for another when the tables were copied."""
    checked = 0
    for name, method in tables()[table]["methods"].items():
        for metric in METRICS:
            if method[metric]:
                assert len(method[metric]) == len(tables()[table]["scenes"])
                error = abs(np.mean(method[metric]) - method["mean"][metric])
                assert error < PRINTED[metric], (name, metric)
                checked += 1
    assert checked == {"synthetic": 20 * 3 - 2, "co3d": 5 * 3}[table]


def test_rows_belong_to_a_name_and_its_cameras():
    rows = published_rows("lego", cameras())
    assert len(rows) == 20 and rows["PlenopticPoints"] == OURS
    assert (next(iter(rows)), list(rows)[-1]) == ("TensoRF", "SRN")
    assert published_rows("other", cameras()) == {}
    assert published_rows("lego", cameras(size=400)) == {}
    assert published_rows("lego", cameras(focal=1000.0)) == {}


def test_another_network_is_no_lpips():
    row = published_rows("ficus", cameras())["NSVF"]
    assert row == {"psnr": 31.23, "ssim": 0.973, "lpips_alex": 0.017}
    assert published_rows("mic", cameras())["Zhang et al."] == {"psnr": 33.82}


def test_co3d_is_known_by_the_sequence():
    for sequence, scene in CO3D_SEQUENCES.items():
        assert scene in tables()["co3d"]["scenes"]
        assert len(published_rows(sequence, cameras(size=300))) == 5
    row = published_rows("618_100125_200129", [])["PlenopticPoints"]
    assert row == {"psnr": 28.61, "ssim": 0.952, "lpips": 0.068}


def test_what_differs_is_said():
    assert differences("lego", cameras(count=200), 1) == ""
    start = "published: 200 test views of 800x800 pixels; here: "
    assert differences("lego", cameras(count=25), 4) == f"{start}25 test views of 200x200 pixels"
    assert differences("lego", cameras(count=200), 1, "train").startswith(f"{start}200 train")
    assert differences("34_1479_4753", cameras(), 1, "train") == "here: split train"
    assert differences("34_1479_4753", cameras(), 2) == "here: images reduced 2 times"
