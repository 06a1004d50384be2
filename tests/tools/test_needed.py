import sys

import numpy as np
from PIL import Image

from pp_cl.run import load
from tools import needed


def test_the_picture_shows_hull_points_and_tiles(finished, dev, tmp_path, monkeypatch):
    run = load(finished, dev)
    hull, points = needed.cells(run)
    assert hull.sum() == run.header["initial_points"] and points.sum() == run.model.cloud.count
    assert (hull | ~points).all()
    image, is_computed = needed.tiles(run)
    assert image.shape == (32, 32, 3) and is_computed.all()  # an image this small is not planned
    monkeypatch.setattr("pp_cl.engine.network.unet.LEAST_FROZEN", 0)
    large = run.cameras("train")[0].resized(160, 160)
    monkeypatch.setattr(type(run), "cameras", lambda self, split: [large])
    image, is_computed = needed.tiles(run)
    side = len(image) // 4
    tiles = image.reshape(side, 4, side, 4, 3).swapaxes(1, 2).reshape(side * side, -1)
    chosen = is_computed[::4, ::4].ravel()
    computed = {tile.tobytes() for tile in tiles[chosen]}
    assert len(tiles[~chosen]) > 100 and all(t.tobytes() in computed for t in tiles[~chosen])
    file = tmp_path / "a.png"
    monkeypatch.setattr(sys, "argv", ["needed", str(finished), "--out", str(file)])
    assert needed.main() == 0
    colours = np.asarray(Image.open(file).convert("RGB")) / 255
    for colour in (needed.BOX, needed.HULL, needed.POINT):
        assert (np.abs(colours - colour).max(-1) < 0.01).any()
