import re

from matplotlib.figure import Figure

from pp_cl.errors import UserError
from tools import docs_tables
from tools import results as TOOL

ROW = {"name": "lego", "size": "200x200", "preset": "tiny", "steps": 300, "views": 200}
ROW |= {"minutes": 0.5, "psnr": 28.1234, "ssim": 0.95, "lpips": 0.05, "points": 90000}
ROW |= {"psnr_highlights": 25.6, "psnr_others": 28.3, "frame_ms": 14.0, "computed": 1.0}
RASTER = {
    "scene": "grid",
    "points": 250336,
    "size": 200,
    "blend": "alpha",
    "forward_ms": 13.7,
    "backward_ms": 2.1,
}
RASTER |= {"ms": 15.8, "max_err": 8e-8}
TORCH = {"widths": "32,64,128", "size": 200, "variant": "auto", "rel_l2": 4e-7}
TORCH |= {"torch_rel_l2": 4e-7, "torch": "PyTorch 2.13.0 (oneDNN, 2 threads)"}
for key in ("forward", "train"):
    TORCH |= {f"{key}_ours_ms": 13.1, f"{key}_torch_ms": 18.6, f"{key}_ratio": 1.4}
STEP = {"points": 92812, "size": "128x128", "launches": 45}
STEP |= {"stages": [{"stage": "shade", "ms": 6.2}]}
MEMORY = {"name": "tiny", "points": 253464, "device_plan": 7e2, "device": 7e2}
MEMORY |= {"host_plan": 1e3, "host": 1e3}
FOUND = dict.fromkeys(TOOL.PARTS, ROW)
FOUND |= {"demo": [{"what": "mesh", "result": "0.76"}]}
FOUND |= {"rasteriser": [RASTER], "memory": [MEMORY]}
SPLAT = {"name": "demo", "steps": 1500, "seconds": 45.1, "gaussians": 41819}
SPLAT |= {"psnr_same": 25.0, "psnr_larger": 35.2, "beside": 0.015}
HARD = {"case": "a: b", "what": "1 / 0", "naive": "nan", "error": "1e-07", "bound": "1e-06"}
WIDE = TORCH | {"widths": "128,256,512", "size": 256, "variant": "direct", "forward_ratio": 0.6}
FOUND |= {"pytorch": [TORCH, WIDE], "splats": [SPLAT], "stability": [HARD]}
TRADED = {"knob": "default", "ms": 9.0, "psnr": 30.0, "mean_err": 1e-4, "setting": {}}
TRADED |= {"is_default": True, "is_frontier": True}
WORKED = {"name": "demo", "box": 9000, "hull": 0.3, "left": 0.1, "stored": 20.0, "whole": 90.0}
WORKED |= {"fragments": 4e5, "blended": 0.6, "computed": 0.5, "drawn": 0.7, "touched": 0.2}
FOUND |= {"work": [WORKED], "frontier": [TRADED]}
MESH = {"name": "demo", "faces": 100_000, "guessed": 0.1, "parts": 1, "euler": -8}
MESH |= {"roughness": 5.7, "mean": 0.22, "median": 0.18, "back": 0.5}
FOUND |= {"meshes": [MESH]}
FOUND |= {f"stages_{preset}": STEP for preset in TOOL.STEPS}


def test_tables_and_plots(tmp_path):
    about = dict.fromkeys(("commit", "date", "machine", "decides"), "1")
    for contents in TOOL.tables(FOUND).values():
        written = docs_tables.table(about | contents)
        last = written.splitlines()[-1]
        cells = re.split("  +", last.strip()) if contents.get("is_plain") else last.split("|")[1:-1]
        assert len(cells) == len(contents["columns"]) and all(cell.strip() for cell in cells)
    TOOL.draw(FOUND, "2 cores", tmp_path)
    assert len({*tmp_path.glob("*.png")}) == 6


def test_work_is_told_in_shares(tmp_path, monkeypatch):
    """Of 1000 cells, 200 are in the hull and 100 have points."""
    cells = {"box": 1000, "hull": 200, "left": 100}
    cells |= {"checkpoint_bytes": 2 * 2**20, "box_bytes": 20 * 2**20}
    counted = {"drawn": 50.0, "fragments": {"found": 800.0, "blended": 600.0}}
    counted |= {"step": {"touched": 30.0}, "network": {"multiplications": 4e9, "whole": 1.6e10}}
    monkeypatch.setattr(TOOL, "read_found", lambda *words: {"cells": cells, "work": counted})
    row = {"box": 1000, "hull": 0.2, "left": 0.1, "stored": 2, "whole": 20, "fragments": 800}
    row |= {"blended": 0.75, "computed": 0.25, "drawn": 0.5, "touched": 0.3}
    assert TOOL.work(tmp_path) == [{"name": name} | row for name in TOOL.WORKED.values()]


def test_each_point_of_speed_has_its_name():
    rows = TOOL.timed(FOUND)
    assert [row["panel"] for row in rows] == [
        "rasteriser",
        "network of 32, 64, 128 channels, 200x200",
        *["network of 128, 256, 512 channels, 256x256"] * 2,
    ]
    labels = [row["label"].replace("\n", " ") for row in rows]
    assert labels[0] == "grid, 250 k points, 200x200 pixels"
    assert labels[1:] == [
        "pp-cl, auto (1.40 times PyTorch's speed)",
        "pp-cl, direct (0.60 times PyTorch's speed)",
        "PyTorch",
    ]


def test_others_results_stand_beside_images_of_their_size():
    figure = Figure()
    rows = [ROW | {"size": size} for size in ("200x200", "400x400", "800x800")]
    TOOL.plot_quality(figure, [*rows, ROW | {"name": "head"}])
    shown = {
        axes.get_title(): {text.get_text() for text in axes.get_legend().get_texts()}
        for axes in figure.axes
    }
    assert shown == {
        "lego, 200x200": {"pp-cl", "OpenSplat, one core"},
        "lego, 400x400": {"pp-cl"},
        "lego, 800x800": {"pp-cl", "PlenopticPoints' paper", "NVIDIA GPUs"},
        "photographs, 200 pixels": {"head"},
    }


def test_a_budget_is_given_to_the_training(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(TOOL, "run_program", lambda *words: commands.append(words))
    metrics = {"per_image": [], "mean": {}, "views": {"images": ["800x800"]}, "downscale": 1}
    metrics |= {"seconds_per_frame": 1, "computed_fraction": 1, "iterations": 9, "seconds": 60}
    metrics |= {"points": {"left": 9}}
    monkeypatch.setattr(TOOL, "read_found", lambda *words: metrics)
    TOOL.train(TOOL.Training("demo", "demo", "tiny", minutes=2), tmp_path)
    assert commands[0][-2:] == ("--minutes", 2)
    assert len({TOOL.key_of(training) for training in TOOL.CURVES}) == len(TOOL.CURVES)


def test_lego_has_its_highlights_apart(tmp_path, monkeypatch):
    views = [{"name": f"test/r_{i}.png", "psnr": 20.0 if 1 <= i <= 13 else 30.0} for i in range(20)]
    metrics = {"per_image": views, "mean": {"psnr": 23.5, "ssim": 0.9}, "seconds_per_frame": 0.1}
    metrics |= {"computed_fraction": 1.0, "views": {"images": ["800x800"]}, "downscale": 4}
    metrics |= {"iterations": 300, "seconds": 7, "points": {"left": 9}}
    monkeypatch.setattr(TOOL, "run_program", lambda *words: None)
    monkeypatch.setattr(TOOL, "read_found", lambda *words: metrics)
    monkeypatch.setattr(TOOL, "scene_of", lambda name: name)
    trainings = (TOOL.TRAININGS[0], *TOOL.lego("tiny", 4, 300))
    rows = {training.name: TOOL.train(training, tmp_path) for training in trainings}
    cell = next(
        column["cell"] for column in TOOL.columns(TOOL.QUALITY[1]) if "r_13" in column["head"]
    )
    assert docs_tables.cell(cell, rows["lego"]) == "20.00, 30.00"
    assert docs_tables.cell(cell, rows["demo"]) == ""


def test_what_fits_into_the_minutes_is_measured(tmp_path, monkeypatch):
    """The device takes twice as long as an H200, and PyTorch is missing."""
    now = [0.0]

    def part(name):
        def measured(store):
            if name == "pytorch":
                raise UserError("install PyTorch")
            now[0] += 60 * 2 * TOOL.WORTH[name]
            return [{"name": name}]

        return measured

    monkeypatch.setattr(TOOL, "PARTS", {name: part(name) for name in TOOL.WORTH})
    monkeypatch.setattr(TOOL.time, "monotonic", lambda: now[0])
    left_out = TOOL.measure_within(tmp_path, 9)
    assert now[0] / 60 == 8
    assert left_out == [
        "lego_22000 (too little time)",
        "pytorch (install PyTorch)",
        "stages_full (too little time)",
    ]


def test_hard_cases_beside_naive_formulas(tmp_path, monkeypatch):
    hard = {"what": "1 / 0", "error": 1e-7, "bound": 1e-6}
    variants = [hard | {"naive": naive} for naive in ("nan", "inf", 1234.5)]
    variants.append(hard | {"naive": 1234.0, "error": 0.0, "bound": 0.0})
    cases = [{"case": "a: b", "hard": variant} for variant in variants]
    monkeypatch.setattr(TOOL, "read_found", lambda *words: {"cases": cases})
    rows = TOOL.stability(tmp_path)
    assert [row["naive"] for row in rows] == ["nan", "inf", "1.2e+03", "1234"]
    assert rows[0] == HARD and rows[3] == HARD | {"naive": "1234", "error": "0", "bound": "0"}
