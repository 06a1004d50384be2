"""Train a scene with each of the network's blocks and several seeds, and write the table that
compares them: the supplemental's ablation of the decoder.

    python tools/ablate.py .../lego --downscale 4 --steps 1150 --seeds 1,2,3 --out runs/ablation

Seed by seed, one run after the other, so that times suffer alike from whatever else the machine
does. Given again, the command goes on with the run that was interrupted; runs that are finished and
evaluated are taken as they are. The table goes to docs/results/, for tools/docs_tables.py.
"""

import argparse
import json
import math
import subprocess
import sys
from pathlib import Path

import pp_cl
from pp_cl.commands.options import add_device, add_set, integer, several
from pp_cl.config import load_config
from pp_cl.device.device import Device
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.files.run_folder import RunFolder
from pp_cl.network.layers import BLOCKS, convolutions, unet_layers
from pp_cl.run import evaluate_run
from pp_cl.session import train_scene
from pp_cl.sweep.plan import Job, plan, read_varied
from pp_cl.sweep.result import finished_row

ROOT = Path(__file__).parents[1]
METRICS = ("psnr", "ssim", "lpips")
# of a run's row: {key: (head of its column, format of a number)}
MEASURED = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "step_ms": ("ms a step", ".1f"),
    "frame_ms": ("ms a frame", ".1f"),
}
WORDS = {
    "double": "two 3x3 convolutions with ReLU (`double`)",
    "single": "one 3x3 convolution with ReLU (`single`)",
    "gated": "one gated 3x3 convolution (`gated`)",
}


def plan_runs(
    scene: str, out: Path, steps: int, seeds: list[int], *, given: list[tuple[str, str, str]]
) -> list[Job]:
    """The runs, seed by seed. given: settings of all of them. Raises UserError as sweep.plan."""
    varied = read_varied([f"network.blocks={','.join(BLOCKS)}"])
    given = [*given, ("train.iterations", str(steps), "--steps")]
    jobs = plan([scene], out, seeds, varied, given=given, metrics=METRICS)
    return sorted(jobs, key=lambda job: job.seed)


def run_job(job: Job, device: str | None) -> dict:
    """The row of a run, trained and evaluated as far as it is not: sweep.result.finished_row, and
    "blocks", "step_ms", "frame_ms".
    """
    if finished_row(job) is None:
        settings = {key: text for key, text, _ in job.given}
        train_scene(job.scene, job.folder, device=device, settings=settings)
        evaluate_run(job.folder, "test", job.metrics, device=device)
    row = finished_row(job)
    if row is None or row["seconds"] is None:
        raise UserError(f"{job.folder}: its log or evaluation is lost; remove the folder")
    measured = json.loads((RunFolder(job.folder).evaluation("test") / "metrics.json").read_text())
    return row | {
        "blocks": dict(job.varied)["network.blocks"],
        "step_ms": 1e3 * row["seconds"] / job.iterations,
        "frame_ms": 1e3 * measured["seconds_per_frame"],
    }


def parameters(widths: tuple[int, int, int], blocks: str) -> int:
    """How many weights and biases a network has."""
    shapes = [x.weight_shape() for x in convolutions(unet_layers(widths, blocks=blocks))]
    return sum(math.prod(shape) + shape[0] for shape in shapes)


def summary(rows: list[dict], widths: tuple[int, int, int]) -> list[dict]:
    """A row for each of the blocks, in their order: "parameters", and of what was measured the mean
    over its runs, the lowest and the highest, as KEY, KEY_low, KEY_high.
    """
    found = []
    for blocks in BLOCKS:
        some = [row for row in rows if row["blocks"] == blocks]
        line = {"blocks": WORDS[blocks], "parameters": parameters(widths, blocks)}
        for key in MEASURED:
            values = [row[key] for row in some if key in row]
            if values:
                mean = math.fsum(values) / len(values)
                line |= {key: mean, f"{key}_low": min(values), f"{key}_high": max(values)}
        found.append(line | {"seeds": [row["seed"] for row in some]})
    return found


def results(jobs: list[Job], rows: list[dict], dev: Device, command: str) -> dict:
    """A file of docs/results, as tools/docs_tables.py reads it."""
    job, seeds = jobs[0], sorted({row["seed"] for row in rows})
    config = load_config(RunFolder(job.folder).config)
    reduced = f" reduced {config.scene.downscale} times" * (config.scene.downscale > 1)
    columns = [{"head": "a level", "cell": "{blocks}"}]
    columns.append({"head": "parameters", "cell": "{parameters:,}"})
    for key, (head, form) in MEASURED.items():
        values = f"{{{key}:{form}}} ({{{key}_low:{form}}} to {{{key}_high:{form}}})"
        columns.append({"head": head, "cell": values})
    return {
        "measured": f"{job.name}{reduced}, preset {config.preset}, network of"
        f" {', '.join(map(str, config.network.widths))} channels, {job.iterations:,} steps: mean"
        f" (lowest to highest) of seeds {', '.join(map(str, seeds))}, on the test views",
        "machine": f"{dev.name}, {dev.info['platform']}",
        "command": command,
        "version": pp_cl.__version__,
        **commit(),
        "columns": columns,
        "rows": summary(rows, config.network.widths),
    }


def commit() -> dict[str, str]:
    """{"commit": short hash} of the source; {} where git does not tell."""
    words = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    try:
        found = subprocess.run(words, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return {}
    return {"commit": found.stdout.strip()}


def read_options(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    add = parser.add_argument
    add("scene", metavar="SCENE", help="folder of a scene, or the word demo")
    add("--out", type=Path, required=True, metavar="FOLDER", help="of the runs")
    add("--downscale", metavar="N", help="reduce the images this many times (as pp-cl train)")
    add("--steps", type=int, default=1150, metavar="N", help="of each training (1150)")
    seeds = several(integer(0, 2**32 - 1))
    add("--seeds", type=seeds, default="1,2,3", metavar="S,...", help="(1,2,3)")
    file = ROOT / "docs" / "results" / "ablation_blocks.json"
    add("--json", type=Path, default=file, metavar="FILE", help="docs/results/ablation_blocks.json")
    add_set(parser, "a setting of all runs")
    add_device(parser)
    return parser.parse_args(arguments)


def command_of(options: argparse.Namespace) -> str:
    """What was typed, as a document shows it."""
    words = ["python tools/ablate.py", f".../{Path(options.scene).name}"]
    words += [f"--downscale {options.downscale}"] * bool(options.downscale)
    seeds = ",".join(map(str, options.seeds))
    words += [f"--steps {options.steps}", f"--seeds {seeds}", "--out FOLDER"]
    return " ".join(words + [f"--set {key}={text}" for key, text, _ in options.set])


def main(arguments: list[str] | None = None) -> int:
    """Train, evaluate, print, write; the exit status is 2 for bad input."""
    options = read_options(arguments)
    try:
        if not options.json.resolve().parent.is_dir():
            raise UserError(f"--json {options.json}: no such folder; make it first")
        given = options.set
        if options.downscale:
            given.append(("scene.downscale", options.downscale, "--downscale"))
        jobs = plan_runs(options.scene, options.out, options.steps, options.seeds, given=given)
        dev, rows = open_device(options.device), []
        for job in jobs:
            rows.append(run_job(job, options.device))
            values = [f"{key} {rows[-1][key]:{form}}" for key, (_, form) in shown(rows[-1]).items()]
            print(f"{job}: {', '.join(values)}", flush=True)
        write_json(options.json, results(jobs, rows, dev, command_of(options)))
    except UserError as error:
        print(f"ablate: {error}", file=sys.stderr)
        return 2
    print(f"wrote {options.json}")
    return 0


def shown(row: dict) -> dict[str, tuple[str, str]]:
    """The part of MEASURED that a row has."""
    return {key: pair for key, pair in MEASURED.items() if key in row}


if __name__ == "__main__":
    sys.exit(main())
