"""Test the row for photographs in docs/capture.md, which says how exact a capture is."""

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs the extra `capture`")

from pp_cl.cli import main
from pp_cl.files.image import read_mask
from pp_cl.scene.listing import scene_frames
from tools.capture_demo import compare, write_photographs

PAGE = Path(__file__).parents[3] / "docs" / "capture.md"
ROW = re.compile(
    r"\| 64 photos, 400x400 \| ([\d.]+) units, at most ([\d.]+) degrees \| ([\d.]+) \|"
)


@pytest.mark.slow
def test_the_demo_in_a_room_is_as_exact_as_the_page_says(dev, tmp_path):
    """Cameras may be off by a quarter more than stated, masks by 0.005."""
    [stated] = ROW.findall(PAGE.read_text("utf-8"))
    position, degrees, overlap = map(float, stated)
    write_photographs(dev, tmp_path / "taken", 400)
    photographs, scene = str(tmp_path / "taken/images"), tmp_path / "scene"
    assert main(["capture", photographs, "--out", str(scene)]) == 0
    placed, alignment = compare(scene, "photographs")
    assert placed == 64
    assert alignment.position < 1.25 * position + 5e-5 and alignment.degrees < 1.25 * degrees
    shares = []
    for split in ("train", "test"):
        for image_file in scene_frames(scene, split):
            name = f"{Path(image_file.name).stem}.png"
            mask, true = (
                read_mask(f / name) > 127 for f in (scene / "masks", tmp_path / "taken/masks")
            )
            shares.append((mask & true).sum() / (mask | true).sum())
    assert np.mean(shares) > overlap - 0.005
