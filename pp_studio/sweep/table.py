"""Reads the rows of a sweep from its runs' folders and makes their table: means and spread over
seeds, and means over scenes; as Markdown and JSON.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pp_cl import RunFolder
from pp_cl.config import load_config, refuse_setting, run_config
from pp_cl.errors import UserError
from pp_cl.files import write_json, write_text
from pp_studio.sweep.plan import Job

TABLES = ("sweep.json", "sweep.md")
Row = dict[str, Any]  # of one run, or means over several

# {key of a row: (column, format of a number)}
COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "points": ("points", ".0f"),
    "seconds": ("seconds", ".1f"),
}


def failed_row(job: Job, error: str) -> Row:
    """The row of a failed run: "scene", "settings", "seed", "folder" and "error", one line."""
    about = {"scene": job.name, "settings": job.varied, "seed": job.seed, "folder": job.folder}
    return about | {"error": error}


def finished_row(job: Job) -> Row | None:
    """The row of a trained and evaluated run: "scene", "settings", "seed", "folder", its metrics,
    "points", "seconds" of training (None if the log is lost) and "device"; None for other runs.

    Raises UserError if the folder holds a run with other settings.
    """
    folder = RunFolder(job.folder)
    if not (folder.config.exists() and folder.checkpoint.exists()):
        return None
    config, there = run_config(folder, job.scene, job.preset, job.given), load_config(folder.config)
    if config.train.iterations != there.train.iterations:
        refuse_setting(folder, "train.iterations", there.train.iterations, config.train.iterations)
    if there.scene.path != config.scene.path:
        return None  # the training refuses it or, if it is the same scene, goes on with it
    try:
        result = folder.measured()
    except UserError:
        return None  # evaluate it again
    if not (result and result["finished"] and result["step"] == config.train.iterations):
        return None
    if not {*job.metrics} <= result["mean"].keys():
        return None
    seconds = [row["seconds"] for row in folder.rows() if row.get("finished")]
    row = failed_row(job, "") | {name: result["mean"][name] for name in job.metrics}
    del row["error"]
    row |= {"points": result["points"], "device": result["device"]}
    return row | {"seconds": seconds[-1] if seconds else None}


def scene_means(rows: Sequence[Row]) -> list[Row]:
    """{"scene", "settings", "runs", "failed"}, means over successful seeds and, if several,
    "spread", {key: standard deviation}, for each scene and setting in the order of the rows.
    """
    means = []
    for group in _groups(rows, ("scene", "settings")):
        good = [row for row in group if "error" not in row]
        head = {"scene": group[0]["scene"], "settings": group[0]["settings"]}
        head |= {"runs": len(good), "failed": len(group) - len(good)} | _over(good)
        means.append(head | {"spread": _over(good, statistics.stdev) if good[1:] else {}})
    return means


def overall_means(means: Sequence[Row]) -> list[Row]:
    """For each setting of scene_means(): {"settings", "scenes", "missing"} and the means over the
    scenes, all with equal weight. missing: scenes without a successful run.
    """
    overall = []
    for group in _groups(means, ("settings",)):
        good = [row for row in group if row["runs"]]
        counts = {"scenes": len(good), "missing": len(group) - len(good)}
        overall.append({"settings": group[0]["settings"]} | counts | _over(good))
    return overall


def _groups(rows, keys):
    """Lists of the rows that have the same values under the keys."""
    groups = {}
    for row in rows:
        groups.setdefault(repr([row[key] for key in keys]), []).append(row)
    return groups.values()


def _over(rows, measure=statistics.fmean):
    """{key: mean, or another measure} of measured values; keys that a row lacks are left out."""
    columns = {key: [row.get(key) for row in rows] for key in COLUMNS}
    return {
        key: measure(values) for key, values in columns.items() if values and None not in values
    }


def markdown(rows: Sequence[Row]) -> str:
    """The table: a line for each scene and setting; with several scenes, a line for the mean of
    each setting; and the failed runs below.
    """
    means = scene_means(rows)
    shown = [key for key in COLUMNS if any(key in row for row in means)]
    labelled = [(row["scene"], row["runs"], row["failed"], "", row) for row in means]
    if len({row["scene"] for row in means}) > 1:
        overall = overall_means(means)
        labelled += [("mean", row["scenes"], row["missing"], " scenes", row) for row in overall]
    lines = [["run", "number", *(COLUMNS[key][0] for key in shown)]]
    for name, good, bad, what, row in labelled:
        count = f"{good} of {good + bad}{what}" if bad else f"{good}{what}"
        cells = [_cell(row, key) for key in shown]
        lines.append([" ".join([name, *_settings(row)]).replace("|", "\\|"), count, *cells])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    table = ""
    for name, *cells in lines:
        padded = [name.ljust(widths[0]), *map(str.rjust, cells, widths[1:])]
        table += f"| {' | '.join(padded)} |\n"
    failed = [f"- {run_text(row)}: {row['error']}\n" for row in rows if "error" in row]
    return table + ("\nFailed:\n\n" + "".join(failed) if failed else "")


def _cell(row, key):
    """A column's mean and, with several seeds, its spread."""
    parts = (row, row.get("spread", {}))
    return " ± ".join(format(part[key], COLUMNS[key][1]) for part in parts if key in part) or "-"


def run_text(row: Row) -> str:
    """The name of a row's run: scene, setting and seed."""
    return " ".join([row["scene"], *_settings(row), f"seed {row['seed']}"])


def _settings(row):
    """The varied settings of a row, as --vary takes them."""
    return [f"{key}={text}" for key, text in row["settings"].items()]


def values_text(row: Row) -> str:
    """One line with the measured values of a run, or why it failed."""
    if "error" in row:
        return f"failed: {row['error']}"
    present = {key: column for key, column in COLUMNS.items() if row.get(key) is not None}
    return ", ".join(f"{name} {row[key]:{form}}" for key, (name, form) in present.items())


def write_tables(out: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """Write the rows to the folder as TABLES; returns the content of the first."""
    means = scene_means(rows)
    content = {"runs": list(rows), "scenes": means, "mean": overall_means(means)}
    write_json(out / TABLES[0], content)
    write_text(out / TABLES[1], markdown(rows))
    return content
