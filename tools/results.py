"""Measure what README.md and docs/ state as results of this code: `make results`.

Every part is a process: a training with its evaluation, a bench, a tool. Its result is stored in
runs/results/, so that the same command goes on where it was stopped; if the code that decides the
numbers (tools/provenance.py) changes, all parts are measured anew. A table is written to
docs/results/ once all its parts are measured, a plot likewise; `make docs` puts them into the
pages. Scenes are looked for in PP_DATA (../shared/data). It takes hours in which nothing else
should run.

`--kind NAME` measures for another processor, driver (PP_DEVICE) or GPU. Results are stored in
runs/results-NAME/, and the tables of the parts measured so far go to docs/results/NAME/, for the
marker `table: kinds` or markers of their own. `--minutes N`, on a GPU that is lent for a while,
measures the parts of WORTH for which there is time, and names the parts that it left out.
"""

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, TypeAlias

from pp_cl.bench.plots import plot_frontier
from pp_cl.commands.info import MIB
from pp_cl.drivers import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.metrics.published import tables as published
from pp_cl.selftest.run import Hard
from pp_studio.export import BEST, QUALITIES, QUICK
from tools.provenance import DECIDES, digest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
DATA = Path(os.environ.get("PP_DATA", ROOT.parent / "shared" / "data"))
WIDTHS = {16: "AVX-512", 8: "AVX2", 4: "vectors of 128 bits"}  # floats in a vector of the device

LEGO, ALL_VIEWS = "nerf_synthetic/lego", "nerf_synthetic/lego_all"
HEAD = "ethiopian_head"
HIGHLIGHTS = {f"test/r_{i}.png" for i in range(1, 14)}  # lego's views with a highlight
TOOL = (sys.executable, "-m")
PP_CL = (*TOOL, "pp_cl")
OPENSPLAT = [(3.6, 24.2), (14.0, 29.9)]  # minutes on one core, PSNR, of its CPU build 15b7e80
# lego at 800x800 on NVIDIA GPUs: minutes, PSNR (docs/results.md names the sources)
ON_GPUS = {
    "3DGRT": (7.8, 36.70),
    "3DGUT": (3.7, 36.47),
    "TensoRF": (10.0, 36.49),
    "3DGS-MCMC": (8.9, 35.75),
    "3DGS": (6.0, 35.70),
    "Instant-NGP": (2.7, 35.65),
    "gsplat": (13.5, 32.13),
}
RASTERISED = (("grid", 250_000, 200), ("grid", 4_000_000, 800), ("pulsar", 100_000, 800))
NETWORKS = (("128,256,512", 256), ("32,64,128", 200))  # widths, side of the image


Found: TypeAlias = dict | list[dict]


@dataclass(frozen=True)
class Training:
    """A training, and the scene of its test views if they are elsewhere."""

    name: str
    scene: str
    preset: str
    iterations: int | None = None  # None: the preset's number, or as many as its minutes allow
    downscale: int | None = None
    test: str | None = None
    is_captured: bool = False  # `scene` is a folder of photographs, from which `capture` makes one
    minutes: float | None = None  # its time budget


def lego(preset: str, downscale: int, *steps: int) -> list[Training]:
    """Trainings on lego of several lengths, each with schedules of its own."""
    return [Training("lego", LEGO, preset, n, downscale, ALL_VIEWS) for n in steps]


TRAININGS = [
    Training("demo", "demo", "tiny", 1500),
    Training("demo", "demo", "tiny", 12000),
    *lego("tiny", 4, 300, 1150, 8000),
    *lego("small", 2, 6000),
    *lego("full", 1, 22000),
    Training("ethiopian_head, 57 photographs", HEAD, "tiny"),
    Training("mary_rose, 60 photographs", "real/mary_rose", "tiny"),
    Training("DTU scan37, 42 photographs", "real/dtu_scan37", "tiny"),
    *(
        Training(f"{name} photographs alone", scene, "tiny", is_captured=True)
        for name, scene in (
            ("ethiopian_head, 66", "ethiopian_head_photos"),
            ("mary_rose, 69", "real/mary_rose/images"),
        )
    ),
]

# PSNR against minutes: a curve joins these and the TRAININGS of the same name and preset
CURVES = [
    Training(name, scene, preset, None, downscale, test, minutes=minutes)
    for name, scene, preset, downscale, test, budgets in (
        ("lego", LEGO, "tiny", 4, ALL_VIEWS, (0.5, 1, 2, 4)),
        ("lego", LEGO, "small", 2, ALL_VIEWS, (1, 2, 4, 8)),
        ("lego", LEGO, "full", 1, ALL_VIEWS, (2, 4, 8, 16)),
        ("ethiopian_head, 57 photographs", HEAD, "tiny", None, None, (0.5, 1, 2, 4)),
        ("mary_rose, 60 photographs", "real/mary_rose", "tiny", None, None, (0.5, 1, 2, 4)),
        ("DTU scan37, 42 photographs", "real/dtu_scan37", "tiny", None, None, (0.5, 1, 2, 4)),
    )
    for minutes in budgets
]

# {preset: the training that stages() continues to time its steps}
STEPS = {"tiny": "lego_8000", "full": "lego_22000"}
# {part: the most minutes it takes on an H200} that --minutes measures, the most telling first
WORTH = {"demo_1500": 1.0, "lego_8000": 1.5, "lego_22000": 4.4}
WORTH |= {"rasteriser": 1.0, "pytorch": 1.0, "stages_tiny": 0.5, "stages_full": 1.0}
# {part whose run is examined: its name in the rows} by work(), splats() and meshes(); TRADED: by
# frontier()
WORKED = {"demo_1500": "demo", "lego_8000": "lego 200x200"}
SPLATTED = WORKED | {"lego_6000": "lego 400x400", "ethiopian_head": "ethiopian_head"}
MESHED = {"demo_1500": "demo, 1,500 steps", "ethiopian_head": "ethiopian_head, 8,000 steps"}
TRADED = "lego_8000"


def columns(text: str) -> list[dict[str, str]]:
    """The columns of a table, written as `head = cell | head = cell`."""
    pairs = (column.split(" = ") for column in text.split(" | "))
    return [{"head": head, "cell": cell} for head, cell in pairs]


QUALITY = (
    "means over the held-out views; minutes of training alone",
    "scene = {name} | size = {size} | preset, steps = `{preset}`, {steps:,}"
    " | minutes = {minutes:.2f} | PSNR = {psnr:.2f}"
    " | PSNR: r_1 to r_13, others = {psnr_highlights:.2f}, {psnr_others:.2f} | SSIM = {ssim:.4f}"
    " | LPIPS = {lpips:.4f} | points = {points:,} | ms a frame = {frame_ms:.0f}",
)
# {table: (what the numbers are, with {steps} and {torch} from tables(); its columns())}
TABLES = {
    "trainings": QUALITY,
    "curves": (
        QUALITY[0],
        "scene, size = {name}, {size} | preset, steps = `{preset}`, {steps:,}"
        " | minutes = {minutes:.2f} | PSNR = {psnr:.2f} | ms a frame = {frame_ms:.0f}",
    ),
    "rasteriser": (
        "milliseconds, medians of interleaved runs, and the largest error against float64",
        "scene = {scene} | points = {points:,} | side = {size} | blend = {blend}"
        " | forward, ms = {forward_ms:.1f} | backward, ms = {backward_ms:.1f}"
        " | error = {max_err:.1e}",
    ),
    "pytorch": (
        "ours, PyTorch's, theirs over ours; medians of interleaved runs, {torch}",
        "widths = {widths} | side = {size} | variant = `{variant}`"
        " | forward, ms = {forward_ours_ms:.2f}, {forward_torch_ms:.2f}"
        " | ratio = {forward_ratio:.2f}"
        " | with backward, ms = {train_ours_ms:.2f}, {train_torch_ms:.2f}"
        " | ratio = {train_ratio:.2f} | relative L2 error = {rel_l2:.1e}, {torch_rel_l2:.1e}",
    ),
    "stages": (
        "medians of a step on lego ({steps})",
        " | ".join(["stage = {stage}", *(f"{name}, ms = {{ms_{name}:.2f}}" for name in STEPS)]),
    ),
    "demo": ("runs of the demo", "measured on = {what} | result = {result}"),
    "meshes": (
        "meshes as exported; roughness is the mean angle of neighbouring faces, distances are in"
        " spacings",
        "run = {name} | faces = {faces:,} | of them guessed = {guessed:.1%} | parts = {parts}"
        " | Euler number = {euler} | roughness, degrees = {roughness:.1f}"
        " | from the surface: mean, median = {mean:.2f}, {median:.2f}"
        " | surface from it = {back:.2f}",
    ),
    "splats": (
        "processor seconds a core; means over five test views, drawn as viewers draw splats",
        "run = {name} | steps = {steps:,} | seconds = {seconds:.0f} | Gaussians = {gaussians:,}"
        " | PSNR = {psnr_same:.1f} | three times as large = {psnr_larger:.1f}"
        " | beside the hull = {beside:.1%}",
    ),
    "stability": (
        "errors against float64",
        "hard case = {case} | naive formula = {what} | gives = {naive} | ours = {error}"
        " | bound = {bound}",
    ),
    "work": (
        "what runs compute; means over eight training views",
        "run = {name} | cells of the box = {box:,} | in the hull, with a point = {hull:.1%},"
        " {left:.1%} | checkpoint; with all cells = {stored:.0f} MiB; {whole:.0f} MiB"
        " | fragments a view, blended = {fragments:,.0f}, {blended:.0%}"
        " | network of a whole image's = {computed:.0%}"
        " | points drawn, with gradients in a step = {drawn:.0%}, {touched:.0%}",
    ),
}


# ---- parts: each returns its measurements


def run_program(*words: object) -> None:
    """Run a program; raises UserError with its last lines if it fails."""
    print("$", *words[1:], flush=True)
    done = subprocess.run([str(w) for w in words], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        raise UserError(f"{' '.join(map(str, words[1:]))}: {done.stderr[-2000:].strip()}")


def read_found(store: Path, *words: object) -> Any:
    """Run a program; returns the contents of its --json file."""
    file = store / "found"
    run_program(*words, "--json", file)
    return json.loads(file.read_text("utf-8"))


def key_of(training: Training) -> str:
    """The name of a training's part, and of its run."""
    name = Path(training.scene).name
    if training.is_captured:
        name = "_".join(Path(training.scene).parts[-2:])
    if training.minutes:
        return f"{name}_{training.preset}_{training.minutes:g}_minutes"
    return f"{name}_{training.iterations}" if training.iterations else name


def train(training: Training, store: Path) -> dict:
    """Train and evaluate; returns a row of trainings or curves."""
    run, scene = store / key_of(training), scene_of(training.scene)
    if training.is_captured:
        scene, photographs = store / f"{key_of(training)}_scene", scene
        run_program(*PP_CL, "capture", photographs, "--out", scene)
    words = ["--preset", training.preset, "--out", run]
    for option in ("iterations", "minutes", "downscale"):
        if number := getattr(training, option):
            words += [f"--{option}", number]
    run_program(*PP_CL, "train", scene, *words)
    words = ["--scene", scene_of(training.test)] if training.test else []
    words += [] if training.minutes else ["--metrics"]  # LPIPS takes longer than a short training
    evaluation = read_found(store, *PP_CL, "eval", run, "--out", run / "all", *words)
    about = read_found(store, *PP_CL, "info", run)
    psnr = {row["name"]: row["psnr"] for row in evaluation["per_image"]}
    means = evaluation["mean"]
    if training.test == ALL_VIEWS:
        means |= {
            "psnr_highlights": fmean(psnr[name] for name in HIGHLIGHTS),
            "psnr_others": fmean(psnr[name] for name in psnr.keys() - HIGHLIGHTS),
        }
    (size,) = about["views"]["images"]
    width, height = (int(side) // about["downscale"] for side in size.split("x"))
    return {
        "name": training.name,
        "size": f"{width}x{height}",
        "preset": training.preset,
        "steps": about["iterations"],
        "views": len(psnr),
        "minutes": round(about["seconds"] / 60, 2),
        **{name: round(value, 4) for name, value in means.items()},
        "points": about["points"]["left"],
        "frame_ms": round(evaluation["seconds_per_frame"] * 1e3, 1),
        "computed": round(evaluation["computed_fraction"], 2),
    }


def rasteriser(store: Path) -> list[dict]:
    """Rows of rasteriser."""
    rows = []
    for scene, points, size in RASTERISED:
        words = ["--scene", scene, "--points", points, "--size", size]
        rows += read_found(store, *PP_CL, "bench", "raster", *words)["rows"]
    return rows


def pytorch(store: Path) -> list[dict]:
    """Rows of pytorch: the paper's network and a narrow one, both of double blocks."""
    rows = []
    for widths, side in NETWORKS:
        for variant in ("direct", "auto"):
            words = ("--widths", widths, "--size", side, "--variant", variant)
            row = read_found(store, *TOOL, "tools.compare_torch", *words)
            times = {f"{p}_{key}": row[p][key] for p in ("forward", "train") for key in row[p]}
            rows.append(row | times | {"widths": widths})
    return rows


def stages(preset: str, store: Path) -> dict:
    """The times by tools/stages.py of a preset's run. Raises UserError if there is none."""
    run = store / STEPS[preset]
    if not run.exists():
        raise UserError(f"the part {run.name} comes first")
    return read_found(store, *TOOL, "tools.stages", scene_of(LEGO), "--out", run)


def by_preset(found: dict[str, dict]) -> list[dict]:
    """Rows of stages."""
    rows: dict[str, dict] = {}
    for preset, steps in found.items():
        for row in steps["stages"]:
            rows.setdefault(row["stage"], {"stage": row["stage"]})[f"ms_{preset}"] = row["ms"]
    return list(rows.values())


def demo(store: Path) -> list[dict]:
    """Rows of demo: errors of depth and alpha of the demo's runs."""
    rows = []
    short, long = (store / key_of(training) for training in TRAININGS[:2])
    for run, steps in ((short, "1,500"), (long, "12,000")):
        errors = read_found(store, *TOOL, "tools.depth_error", run)
        shares = f"median {errors['median']:.1%}, mean {errors['mean']:.1%}"
        rows.append({"what": f"depths within 1.5 spacings, {steps} steps", "result": shares})
        rows.append({"what": f"IoU of alpha, {steps} steps", "result": f"{errors['overlap']:.3f}"})
    return rows


def meshes(store: Path) -> list[dict]:
    """Rows of meshes."""
    return [
        {"name": name} | read_found(store, *TOOL, "tools.export_quality", store / run)
        for run, name in MESHED.items()
    ]


def splats(store: Path) -> list[dict]:
    """Rows of splats: the demo also has one with the best quality."""
    (steps, cell), best = QUALITIES[QUICK], QUALITIES[BEST]
    fits = [(name, (steps,), cell) for name in SPLATTED]
    fits.insert(1, ("demo_1500", best[:1], best[1]))
    rows = []
    for name, numbers, size in fits:
        words = (store / name, "--steps", *numbers, "--cell", size)
        for row in read_found(store, *TOOL, "tools.splat_quality", *words):
            psnr = {"psnr_same": row["psnr"]["1"], "psnr_larger": row["psnr"]["3"]}
            rows.append(row | psnr | {"name": SPLATTED[name]})
    return rows


def stability(store: Path) -> list[dict]:
    """Rows of stability."""
    rows = []
    for row in read_found(store, *PP_CL, "selftest", "--hard")["cases"]:
        numbers = {name: float(row["hard"][name]) for name in ("naive", "error", "bound")}
        hard = Hard(row["hard"]["what"], **numbers)
        shown = dict(zip(numbers, hard.shown(), strict=True))
        rows.append({"case": row["case"], "what": hard.what} | shown)
    return rows


def work(store: Path) -> list[dict]:
    """Rows of work."""
    rows = []
    for name, label in WORKED.items():
        info = read_found(store, *PP_CL, "info", store / name, "--work")
        cells, counted = info["cells"], info["work"]
        fragments, network = counted["fragments"], counted["network"]
        rows.append(
            {
                "name": label,
                "box": cells["box"],
                "hull": cells["hull"] / cells["box"],
                "left": cells["left"] / cells["box"],
                "stored": cells["checkpoint_bytes"] / MIB,
                "whole": cells["box_bytes"] / MIB,
                "fragments": fragments["found"],
                "blended": fragments["blended"] / fragments["found"],
                "computed": network["multiplications"] / network["whole"],
                "drawn": counted["drawn"] / cells["left"],
                "touched": counted["step"]["touched"] / cells["left"],
            }
        )
    return rows


def frontier(store: Path) -> list[dict]:
    """Rows of `pp-cl bench RUN`."""
    scene = ("--scene", scene_of(LEGO))
    return read_found(store, *PP_CL, "bench", store / TRADED, *scene)["rows"]


PARTS: dict[str, Callable[[Path], Found]] = {
    **{key_of(training): partial(train, training) for training in (*TRAININGS, *CURVES)},
    **{part.__name__: part for part in (demo, rasteriser, pytorch)},
    **{f"stages_{preset}": partial(stages, preset) for preset in STEPS},
    **{part.__name__: part for part in (meshes, splats, stability, work, frontier)},
}


# {table: its parts}, unless the table has the name of its only part
OF_TABLE = {
    "trainings": {key_of(training) for training in TRAININGS},
    "curves": {key_of(training) for training in CURVES},
    "stages": {f"stages_{preset}" for preset in STEPS},
}


def scene_of(name: str) -> Path | str:
    """The scene's folder. Raises UserError if it is not there."""
    if name != "demo" and not (DATA / name).is_dir():
        raise UserError(f"{DATA / name}: not found; set PP_DATA to the folder of the scenes")
    return name if name == "demo" else DATA / name


# ---- from parts to documents


def git(*words: str) -> str:
    """Run git; returns what it prints."""
    command = [shutil.which("git") or "git", *words]
    return subprocess.check_output(command, cwd=ROOT, text=True).strip()


def processor() -> str:
    """The name of the processor."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
        name = re.search(r"(?m)^model name\s*: (.*)$", text)
    except OSError:
        name = None
    return name[1].strip() if name else platform.processor() or platform.machine()


def origin() -> dict[str, str]:
    """Code, date and machine of the results. Raises UserError if code is not committed."""
    if changed := git("status", "--porcelain", "--", *DECIDES):
        raise UserError(f"commit first what decides the numbers: {changed}")
    dev = open_device()
    # not PoCL's longer name: pthread-skylake-avx512-Intel(R) Xeon(R) Processor
    name = processor().replace("(R)", "")
    driver = f"{dev.info['platform']} {dev.info['driver']}"
    vectors = WIDTHS.get(dev.queue.device.native_vector_width_float)
    if dev.is_cpu and vectors:
        name += f", {vectors}"
    gpu = "" if dev.is_cpu else f"{dev.name} beside "
    return {
        "commit": git("log", "-1", "--format=%h", "--", *DECIDES),
        "date": date.today().isoformat(),
        "machine": f"{gpu}{os.cpu_count()} cores ({name}), {driver}",
        "decides": digest(),
    }


def begin(store: Path, commit: str) -> None:
    """Make the folder of results; empty it first if its results are of another commit."""
    mark = store / "commit"
    if not (mark.exists() and mark.read_text("utf-8") == commit):
        shutil.rmtree(store, ignore_errors=True)
        store.mkdir(parents=True)
        mark.write_text(commit, "utf-8")


def measure(store: Path, name: str) -> Found:
    """The result of a part, which is measured unless it is stored."""
    file = store / f"{name}.json"
    if not file.exists():
        write_json(file, PARTS[name](store))
    return json.loads(file.read_text("utf-8"))


def measure_within(store: Path, minutes: float) -> list[str]:
    """Measure the parts of WORTH for which there is time, judged by how slow the device was so
    far. Returns which parts were left out, and why.
    """
    start, expected, left_out = time.monotonic(), 0.0, []
    for name, needed in WORTH.items():
        used = (time.monotonic() - start) / 60
        if used + needed * (max(1, used / expected) if expected else 1) > minutes:
            left_out.append(f"{name} (too little time)")
            continue
        try:
            measure(store, name)
            expected += needed
        except UserError as error:
            left_out.append(f"{name} ({error})")
    return left_out


def trained(found: dict[str, Found], trainings: list[Training]) -> list[dict]:
    """The rows of those trainings that were measured."""
    return [found[key_of(t)] for t in trainings if key_of(t) in found]


def on_curves(found: dict[str, Found]) -> list[dict]:
    """The rows that plot_quality() draws, by rising minutes."""
    names = {training.name for training in CURVES}
    rows = trained(found, [t for t in (*TRAININGS, *CURVES) if t.name in names])
    return sorted(rows, key=lambda row: row["minutes"])


def timed(found: dict[str, Found]) -> list[dict]:
    """The rows that plot_speed() draws: {"panel", "kind", "label", "ms", "error"}."""
    rows: list[dict] = []
    for r in found["rasteriser"]:
        points = f"{r['points'] / 1e6:.2g} M" if r["points"] >= 1e6 else f"{r['points'] // 1000} k"
        label = f"{r['scene']}, {points} points,\n{r['size']}x{r['size']} pixels"
        own = {"panel": "rasteriser", "kind": r["blend"], "label": label}
        rows.append(own | {"ms": r["ms"], "error": r["max_err"]})
    for r in found["pytorch"]:  # rows of one network share a panel
        widths, side = r["widths"].replace(",", ", "), r["size"]
        panel = {"panel": f"network of {widths} channels, {side}x{side}"}
        ratio, ours = r["forward_ratio"], {"ms": r["forward_ours_ms"], "error": r["rel_l2"]}
        label = f"pp-cl, {r['variant']}\n({ratio:.2f} times PyTorch's speed)"
        rows.append(panel | ours | {"kind": r["variant"], "label": label})
        if r["variant"] == "direct":
            torch = {"ms": r["forward_torch_ms"], "error": r["torch_rel_l2"]}
            rows.append(panel | torch | {"kind": "PyTorch", "label": "PyTorch"})
    return rows


def tables(found: dict[str, Found]) -> dict[str, dict]:
    """{name: contents without origin()} of the tables that have rows."""
    runs = {preset: found[f"stages_{preset}"] for preset in STEPS if f"stages_{preset}" in found}
    steps = "; ".join(
        f"{preset}: {run['points']:,} points, {run['size']} pixels, {run['launches']} launches"
        for preset, run in runs.items()
    )
    torch = found["pytorch"][0]["torch"] if "pytorch" in found else ""
    rows = found | {"trainings": trained(found, TRAININGS), "curves": trained(found, CURVES)}
    rows["stages"] = by_preset(runs)
    return {
        name: {
            "measured": what.format(steps=steps, torch=torch),
            "columns": columns(text),
            "rows": rows[name],
        }
        | ({"is_plain": True} if name == "stability" else {})
        for name, (what, text) in TABLES.items()
        if rows.get(name)
    }


def draw(found: dict[str, Found], machine: str, folder: Path) -> None:
    """Draw quality.png, speed.png and frontier.png, and the same for dark pages, each if its parts
    were measured.
    """
    from matplotlib import style
    from matplotlib.figure import Figure

    for suffix, look in (("", "default"), ("_dark", "dark_background")):
        with style.context(look):
            if found.keys() >= OF_TABLE["curves"]:
                figure = Figure(figsize=(11, 4), layout="constrained")
                plot_quality(figure, on_curves(found))
                figure.supxlabel(f"minutes of training on {machine}", fontsize=9)
                figure.savefig(folder / f"quality{suffix}.png", dpi=120)
            if found.keys() >= {"rasteriser", "pytorch"}:
                figure = Figure(figsize=(13, 4), layout="constrained")
                plot_speed(figure, timed(found))
                figure.savefig(folder / f"speed{suffix}.png", dpi=120)
            if "frontier" in found:
                title = f"{WORKED[TRADED]}, on {machine}"
                plot_frontier(found["frontier"], str(folder / f"frontier{suffix}.png"), title)


def plot_quality(figure: "Figure", rows: list[dict]) -> None:
    """Plot PSNR of test views against minutes of training: a panel for each size of lego's images,
    and one with a curve for each capture. Results of other programs are in their size's panel.
    """
    lego = [row for row in rows if row["name"] == "lego"]
    panels = {
        f"lego, {size}": {"pp-cl": [row for row in lego if row["size"] == size]}
        for size in dict.fromkeys(row["size"] for row in lego)
    }
    captures = dict.fromkeys(row["name"] for row in rows if row["name"] != "lego")
    panels["photographs, 200 pixels"] = {
        name: [row for row in rows if row["name"] == name] for name in captures
    }
    for axes, (title, curves) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        axes.set_title(title, fontsize=10)
        axes.set(xscale="log")
        for label, curve in curves.items():
            minutes, psnr = [row["minutes"] for row in curve], [row["psnr"] for row in curve]
            axes.plot(minutes, psnr, "o-", label=label)
        if title == "lego, 200x200":
            label = "OpenSplat, one core"
            axes.plot(*zip(*OPENSPLAT, strict=True), "x--", color="grey", label=label)
        if title == "lego, 800x800":
            table = published()["synthetic"]
            psnr = table["methods"]["PlenopticPoints"]["psnr"][table["scenes"].index("lego")]
            axes.axhline(psnr, color="grey", linewidth=0.7, label="PlenopticPoints' paper")
            axes.plot(*zip(*ON_GPUS.values(), strict=True), "x", color="grey", label="NVIDIA GPUs")
            for name, place in ON_GPUS.items():
                # right above TensoRF's mark is the label of 3DGRT
                offset = (6, -2) if name == "TensoRF" else (3, 3)
                axes.annotate(name, place, offset, textcoords="offset points", fontsize=6)
        low, high = axes.get_ylim()
        axes.set_ylim(bottom=low - 0.25 * (high - low))  # room for the legend
        axes.legend(loc="best", fontsize=7)
        axes.grid(alpha=0.3)
        label_logarithmic(axes)
    figure.supylabel("PSNR of test views, dB", fontsize=9)


def plot_speed(figure: "Figure", timed: list[dict]) -> None:
    """Plot error against time: a panel for the rasteriser and each network, labelled points."""
    names = dict.fromkeys(row["panel"] for row in timed)
    panels = figure.subplots(1, len(names))
    for axes, name in zip(panels, names, strict=True):
        rows = [row for row in timed if row["panel"] == name]
        axes.set_title(name, fontsize=10)
        axes.set(xlabel="milliseconds", ylabel="error against float64")
        most_ms, most_error = (max(row[key] for row in rows) for key in ("ms", "error"))
        if name == "rasteriser":
            axes.set(xscale="log", yscale="log")
            label_logarithmic(axes)
            axes.margins(0.25)
        else:
            axes.set(xlim=(0, 1.3 * most_ms), ylim=(0, 1.3 * most_error))
        for i, kind in enumerate(dict.fromkeys(row["kind"] for row in rows)):
            dots = [row for row in rows if row["kind"] == kind]
            axes.plot([r["ms"] for r in dots], [r["error"] for r in dots], "os^"[i], label=kind)
        for row in rows:
            # "direct" is close to PyTorch, whose label is above
            place = {"xytext": (0, -24 if row["kind"] == "direct" else 7), "ha": "center"}
            where = (row["ms"], row["error"])
            axes.annotate(row["label"], where, textcoords="offset points", fontsize=7, **place)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8, loc="center right")


def label_logarithmic(axes: "Axes") -> None:
    """Label the x axis with 1, 2, 5, 10 and so on."""
    from matplotlib.ticker import LogLocator

    axes.xaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}")
    axes.minorticks_off()


def main() -> int:
    """Measure missing parts, write tables and plots; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--kind", default="", metavar="NAME")
    parser.add_argument("--minutes", type=float, metavar="N")
    options = parser.parse_args()
    store = ROOT / "runs" / "-".join(filter(None, ("results", options.kind)))
    try:
        about = origin()
        begin(store, about["commit"])
        if options.minutes:
            left_out = measure_within(store, options.minutes)
            print("left out:", "; ".join(left_out) or "nothing")
        else:
            for name in options.only:
                measure(store, name)
        parts = {name: measure(store, name) for name in PARTS if (store / f"{name}.json").exists()}
    except UserError as error:
        print(f"results: {error}", file=sys.stderr)
        return 2
    folder = RESULTS / options.kind
    folder.mkdir(parents=True, exist_ok=True)
    for name, contents in tables(parts).items():
        if options.kind or parts.keys() >= OF_TABLE.get(name, {name}):
            write_json(folder / f"{name}.json", about | contents)
    if not options.kind:
        draw(parts, about["machine"], ROOT / "docs")
    return 0


if __name__ == "__main__":
    sys.exit(main())
