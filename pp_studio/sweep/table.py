"""The rows of a sweep, read from the folders of its runs, and their table: means and spread over
seeds, means over scenes; as Markdown and JSON.
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
Row = dict[str, Any]  # of a run, or of means

# {key of a row: (column, format of a number)}
COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "points": ("points", ".0f"),
    "seconds": ("seconds", ".1f"),
}


def failed_row(job: Job, error: str) -> Row:
    """The row of a run that failed: "scene", "settings", "seed", "folder" and "error", one line."""
    about = {"scene": job.name, "settings": job.varied, "seed": job.seed, "folder": job.folder}
    return about | {"error": error}


def finished_row(job: Job) -> Row | None:
    """The row of a run that is trained and evaluated: "scene", "settings", "seed", "folder", its
    metrics, "points", "seconds" of training (None where the log is lost) and "device"; else None.

    Raises UserError where the folder holds a run with other settings.
    """
    folder = RunFolder(job.folder)
    if not (folder.config.exists() and folder.checkpoint.exists()):
        return None
    config, there = run_config(folder, job.scene, job.preset, job.given), load_config(folder.config)
    if config.train.iterations != there.train.iterations:
        refuse_setting(folder, "train.iterations", there.train.iterations, config.train.iterations)
    if there.scene.path != config.scene.path:
        return None  # for the training to refuse or, if it is the same scene, to go on with
    try:
        result = folder.measured()
    except UserError:
        return None  # is measured again
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
    """{"scene", "settings", "runs", "failed"}, means over the seeds that went well, and "spread",
    {key: standard deviation} of several, for each scene and setting, in the order of the rows.
    """
    means = []
    for group in _groups(rows, ("scene", "settings")):
        good = [row for row in group if "error" not in row]
        head = {"scene": group[0]["scene"], "settings": group[0]["settings"]}
        head |= {"runs": len(good), "failed": len(group) - len(good)} | _over(good)
        means.append(head | {"spread": _over(good, statistics.stdev) if good[1:] else {}})
    return means


def overall_means(means: Sequence[Row]) -> list[Row]:
    """{"settings", "scenes", "missing"} and the means over the scenes, each of which counts the
    same, for each setting of scene_means(). missing: scenes without a run that went well.
    """
    overall = []
    for group in _groups(means, ("settings",)):
        good = [row for row in group if row["runs"]]
        counts = {"scenes": len(good), "missing": len(group) - len(good)}
        overall.append({"settings": group[0]["settings"]} | counts | _over(good))
    return overall


def _groups(rows, keys):
    """Lists of the rows whose values under the keys are the same."""
    groups = {}
    for row in rows:
        groups.setdefault(repr([row[key] for key in keys]), []).append(row)
    return groups.values()


def _over(rows, measure=statistics.fmean):
    """{key: mean} of what is measured, or another measure; a key that a row lacks is left out."""
    columns = {key: [row.get(key) for row in rows] for key in COLUMNS}
    return {
        key: measure(values) for key, values in columns.items() if values and None not in values
    }


def markdown(rows: Sequence[Row]) -> str:
    """The table: a line for each scene and setting, for several scenes one for the mean of each
    setting, and below it what failed.
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
    """A column's mean and, of several seeds, its spread."""
    parts = (row, row.get("spread", {}))
    return " ± ".join(format(part[key], COLUMNS[key][1]) for part in parts if key in part) or "-"


def run_text(row: Row) -> str:
    """The run of a row: scene, setting and seed."""
    return " ".join([row["scene"], *_settings(row), f"seed {row['seed']}"])


def _settings(row):
    """What is varied in a row, as --vary takes it."""
    return [f"{key}={text}" for key, text in row["settings"].items()]


def values_text(row: Row) -> str:
    """What was measured of a run, or why it failed, in one line."""
    if "error" in row:
        return f"failed: {row['error']}"
    present = {key: column for key, column in COLUMNS.items() if row.get(key) is not None}
    return ", ".join(f"{name} {row[key]:{form}}" for key, (name, form) in present.items())


def write_tables(out: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """Write the rows as TABLES to the folder; returns what the first holds."""
    means = scene_means(rows)
    content = {"runs": list(rows), "scenes": means, "mean": overall_means(means)}
    write_json(out / TABLES[0], content)
    write_text(out / TABLES[1], markdown(rows))
    return content
