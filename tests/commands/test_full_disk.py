"""A disk that is full when a command writes its result: one line, nothing left; the next try."""

import errno
import os
import shutil

import pytest

from pp_cl.cli import main

# {what is written: words of the command, without the file}; RUN and BALL stand for folders
FILM = ["render", "RUN", "--seconds", "0.2", "--fps", "10", "--out"]
RASTER = ["bench", "raster", "--size", "16", "--points", "100", "--blend", "alpha"]
OUTPUTS = {
    "film.gif": FILM,
    "film.mp4": FILM,
    "frames": FILM,
    "exr": ["render", "RUN", "--path", "test", "--format", "exr", "--out"],
    "cloud.ply": ["export", "RUN", "--format", "ply", "--out"],
    "cloud.glb": ["export", "RUN", "--format", "glb", "--out"],
    "mesh.ply": ["export", "RUN", "--format", "mesh", "--out"],
    "page.html": ["export", "RUN", "--format", "html", "--out"],
    "splat.ply": ["export", "RUN", "--format", "splat", "--out"],
    "splat.glb": ["export", "RUN", "--format", "splat-glb", "--out"],
    "gallery": ["export", "RUN", "--format", "gallery", "--out"],
    "scene": ["export", "RUN", "--format", "scene", "--out"],
    "small": ["compress", "RUN", "--max-loss", "0.01", "--out"],
    "eval": ["eval", "RUN", "--save-images", "--metrics", "psnr", "--out"],
    "info.png": ["info", "RUN", "--picture"],
    "compare.json": ["compare", "BALL/test", "BALL/test", "--metrics", "psnr", "--json"],
    "bench.json": [*RASTER, "--json"],
}


@pytest.fixture(scope="module")
def folders(scene, finished):
    """{name: folder} of a small run and its scene."""
    return {"RUN": str(finished), "BALL": scene}


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_full_disk_is_one_line_and_nothing_is_left(folders, tmp_path, capfd, monkeypatch, name):
    words = [folders.get(word, word).replace("BALL", folders["BALL"]) for word in OUTPUTS[name]]
    out = tmp_path / name
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        patch.setattr(os, "replace", full)
        assert main([*words, str(out)]) == 2
    told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("pp-cl")]
    assert len(told) == 1 and told[0].startswith(f"pp-cl: {tmp_path}") and "space" in told[0]
    assert ".tmp" not in told[0] and not list(tmp_path.rglob(".*.tmp*"))
    assert main([*words, str(out)]) == 0
    assert out.is_file() or any(path.is_file() for path in out.iterdir())
    shutil.rmtree(tmp_path)
