"""Bad input to any command ends with status 2 and one line that names it, before anything is
computed or written.
"""

import shutil
import sys

import pytest
import trimesh

from pp_cl.cli import main
from pp_cl.run import Run

TRAIN = "train BALL --out new"
OF_RUNS = ("eval", "render", "view", "export --format ply", "info --picture a.png")
SHAPE = "compare --mesh ball.ply"
WRITTEN = [  # refused from the command line alone, whether the runs exist or not
    ("trian", "did you mean train?"),
    (f"{TRAIN} --iters 6", "did you mean --iterations?"),
    (f"{TRAIN} --preset smal", "did you mean small?"),
    ("compare a b --metrics psrn", "did you mean psnr?"),
    ("compare a.png a.png --json /no/such/a.json", "--json"),
    ("info run --picture /no/such/a.png", "--picture"),
    ("bench conv --plot /no/such/a.png", "--plot"),
    ("bench unet --plot b.xyz", "--plot"),
    (f"{TRAIN} --speed 9", "--speed"),
    ("export run --format ply --box 0,0,0,1,1,0", "two corners"),
    ("make BALL --out new --minutes 2000", "--minutes"),
    (f"{TRAIN} --set nonsense", "--set"),
    ("sweep demo --out new --seeds a", "--seeds"),
    ("sweep demo --out new --workers 0", "--workers"),
    ("view run --port 70000", "--port"),
    ("bench unet --blocks triple", "--blocks"),
    ("bench raster --blend alpha,beta", "--blend"),
    ("compare run --samples 0", "--samples"),
    ("compare ball.ply --edge nan", "--edge"),
    ("export run", "--format"),
    ("export run --format obj", "obj"),
    ("export run --format ply --min-weight x", "--min-weight"),
    ("export run --format splat --quality 8", "--quality"),
    ("render run --size large", "--size"),
    ("render run --fov nan", "--fov"),
    ("render run --samples 3", "--samples"),
    ("render run --background red", "--background"),
]
REFUSED = [
    (f"{TRAIN} --set trian.seed=1", "did you mean train.seed?"),
    # input that is missing, broken or of another kind
    *((f"{command} none", "none") for command in (*OF_RUNS, SHAPE)),
    *((f"{command} empty", "empty") for command in (*OF_RUNS, SHAPE)),
    *((f"{command} young", "checkpoint.npz") for command in (*OF_RUNS, SHAPE) if command != "view"),
    *((f"{command} run --scene gone", "gone") for command in (*OF_RUNS, SHAPE)),
    ("view full", "no scene in it: '"),
    ("eval run --split val", "val"),
    ("eval unknown", "unknown/config.json"),
    ("train none --out new", "none"),
    ("train broken --out new --points 500", "transforms_train.json"),
    ("sweep none --out new", "none"),
    ("compare none.png none.png", "none.png"),
    ("info broken", "transforms_train.json"),
    ("render run --path nowhere", "nowhere"),
    ("render run --path nowhere.json", "nowhere.json"),
    ("compare run --mesh none.ply", "none.ply"),
    ("compare run", "--mesh"),
    ("bench train --scene none", "none"),
    # outputs that cannot be written
    *((f"{command} --out /proc/a", "/proc/a") for command in ("train BALL", "eval run")),
    ("train BALL --out full", "full"),
    ("train BALL --out file", "file"),
    ("train BALL --out file/new", "file/new"),
    ("sweep demo --out run", "run"),
    ("eval run --save-images --out full", "full"),
    ("eval run --out file", "file"),
    ("render run --out full", "full"),
    ("render run --out /", "/"),
    ("render run --out folder.mp4", "folder.mp4"),
    ("render run --out " + 245 * "x" + ".mp4", "name"),
    ("render run --out /proc/a.mp4", "/proc/a.mp4"),
    ("export run --format ply --out folder.ply", "folder.ply"),
    ("export run --format ply --out " + 250 * "x" + ".ply", "name"),
    ("export run --format glb --out none/a.glb", "none"),
    ("export run --format mesh --out a.off", ".ply or .glb"),
    ("export run --format scene --out .", "folder"),
    *((f"export run --format scene --out {name}", name) for name in ("full", "file")),
    ("export run --format ply --out /proc/a.ply", "/proc/a"),
    ("export run --format scene --out /proc/a", "/proc/a"),
    # devices
    *((f"{command} run --device abacus", "abacus") for command in ("eval", "render")),
    *((f"{command} --device abacus", "abacus") for command in (TRAIN, "bench unet", "selftest")),
    # options that are unknown, belong to other commands or subjects, or exclude each other
    ("info run --scene run --masks run", "--masks"),
    ("info run --set train.seed=1", "--set"),
    ("info run --preset tiny", "--preset"),
    ("info BALL --scene BALL", "--scene"),
    ("view BALL --scene BALL", "--scene: only of a run"),
    ("compare run --edge 1", "--edge"),
    ("compare ball.ply --mesh ball.ply", "--mesh"),
    ("compare ball.ply --metrics psnr", "--metrics"),
    ("sweep demo --out new --json --dry-run", "--json"),
    ("sweep demo --out new --workers 2 --scheduler tcp://a", "--workers"),
    ("bench all --size 64", "--size"),
    ("bench conv --points 9", "--points"),
    ("bench unet --scene demo", "--scene"),
    ("bench raster --widths 16,16,16", "--widths"),
    ("bench train --plot b.png", "--plot"),
    ("bench conv --metrics", "--metrics"),
    ("bench run --size 64", "--size: bench a run"),
    ("bench convv", "did you mean conv"),
    ("bench BALL", "config.json"),
    ("export run other --format html", "other"),
    ("export run other --format gallery", "other"),
    ("export run --format html --min-weight 1", "--min-weight"),
    ("export run --format html --box 0,0,0,1,1,1", "--box"),
    ("export run --format scene --axes viewer", "--axes"),
    ("export run --format ply --box 50,0,0,51,1,1", "nothing lies in it"),
    ("export run --format html --quality best", "--quality"),
    ("render run --background transparent --out a.mp4", "--background"),
    ("render run --background black --format exr --out new", "--background"),
    ("render run --features", "--features"),
    ("render run --format mp4 --out new", "--format"),
    ("render run --format png --out a.mp4", "a.mp4"),
    ("render run --out a.avi", "a.avi"),
    ("render run --fps 60 --out a.gif", "--fps"),
    ("render run --path test --seconds 1", "--seconds"),
    # values that make no sense
    (f"{TRAIN} --set train.offset_rate=0.01,0", "train.offset_rate"),
    (f"{TRAIN} --iterations 9 --set train.iterations=12", "--set: train.iterations"),
    (f"{TRAIN} --iterations 0", "--iterations: train.iterations"),
    (f"{TRAIN} --iterations x", "--iterations"),
    (f"{TRAIN} --downscale 20", "--downscale"),
    (f"{TRAIN} --config none.json", "none.json"),
    (f"{TRAIN} --config run/config.json --preset tiny", "--preset"),
    (f"{TRAIN} --memory 0.001", "--memory 0.001"),
    (f"{TRAIN} --downscale 2 --points 300 --set train.refine_at=0.3,0.6", "train.refine_at"),
    (f"{TRAIN} --set train.crop=6", "--set: train.crop"),
    (f"{TRAIN} --set scene.path=b", "scene.path"),
    ("train demo --out new --masks run", "--masks"),
    (f"{TRAIN} --masks nowhere", "nowhere"),
    (f"{TRAIN} --ignore nowhere", "no such folder"),
    (f"{TRAIN} --ignore empty", "no mask"),
    (f"{TRAIN} --set raster.footprint=disc", "raster.radius: is automatic"),
    (f"{TRAIN} --mask-from colour", "--mask-from"),
    (f"{TRAIN} --set scene.mask_tolerance=0", "mask_tolerance"),
    (f"{TRAIN} --set scene.box=0,0,0,1,1,0", "scene.box"),
    ("export run --format ply --length a:1,2 b:1,2 x", "--length"),
    ("export run --format ply --length a b 1", "PHOTO:X,Y"),
    ("render run --seconds 0.001", "--seconds"),
]


@pytest.fixture(scope="module")
def folder(scene, finished, tmp_path_factory):
    """A folder that all cases share, as none writes anything: a run, runs that lack something, a
    mesh, and files where outputs would go.
    """
    folder = tmp_path_factory.mktemp("refused")
    for name in ("run", "young", "unknown"):
        shutil.copytree(finished, folder / name)
    (folder / "young/checkpoint.npz").unlink()
    (folder / "unknown/config.json").write_text("{}")
    shutil.copytree(scene, folder / "broken")
    (folder / "broken/transforms_train.json").write_text('{"frames": [')
    for name in ("empty", "full", "folder.mp4", "folder.ply"):
        (folder / name).mkdir()
    (folder / "full/holiday.jpg").write_bytes(b"")
    (folder / "file").write_bytes(b"")
    trimesh.creation.icosphere(subdivisions=1).export(folder / "ball.ply")
    return folder


def check_refused(words, named, folder, capsys):
    """Check that the last line names what is wrong and the working folder is unchanged."""
    before = sorted(folder.rglob("*"))
    assert main(words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [text for text in lines if text.startswith("pp-cl")] == lines[-1:]
    assert named in lines[-1]
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("line, named", WRITTEN, ids=[line[:60] for line, _ in WRITTEN])
def test_what_makes_no_sense_is_one_line(tmp_path, capsys, monkeypatch, line, named):
    monkeypatch.chdir(tmp_path)
    check_refused(line.split(), named, tmp_path, capsys)


@pytest.mark.parametrize("line, named", REFUSED, ids=[line[:60] for line, _ in REFUSED])
def test_bad_input_is_one_line_and_nothing_is_done(folder, scene, capsys, monkeypatch, line, named):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(Run, "render", None)  # fails if anything is rendered
    monkeypatch.setitem(sys.modules, "pp_studio.sweep.cluster", None)
    words = [scene if word == "BALL" else word for word in line.split()]
    check_refused(words, named, folder, capsys)
