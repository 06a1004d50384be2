"""What the folder of a run says about it: its row of the table, how far it is."""

import json
import math
from typing import Any

from pp_cl.config import load_config
from pp_cl.files.run_folder import MOST_METRICS, RunFolder
from pp_cl.files.untrusted import read_json_text
from pp_cl.session import run_config
from pp_cl.sweep.plan import Job
from pp_cl.training.checkpoint import opened_run


def about(job: Job) -> dict[str, Any]:
    """{"scene", "settings", "seed", "folder"}: what a row says of any run."""
    return {
        "scene": job.name,
        "settings": dict(job.varied),
        "seed": job.seed,
        "folder": job.folder,
    }


def failed_row(job: Job, error: str) -> dict[str, Any]:
    """The row of a run that failed. error: one line."""
    return about(job) | {"error": error}


def finished_row(job: Job) -> dict[str, Any] | None:
    """The row of a run that is trained and evaluated: about(), its metrics, "points", "seconds" of
    training (None where the log is lost) and "device"; else None.

    Raises UserError where the folder holds a run with other settings, or a broken one.
    """
    folder = RunFolder(job.folder)
    if not folder.config.exists():
        return None
    config = run_config(folder, job.scene, job.preset, job.given)
    if not folder.checkpoint.exists():
        return None
    if load_config(folder.config).scene.path != config.scene.path:
        return None  # for the training to refuse or, if it is the same scene, to go on with
    with opened_run(folder, config) as stored:
        header = stored.header
    measured = _measured(folder, header, job.metrics) if header["finished"] else None
    if measured is None:
        return None
    log = [row for row in folder.rows() if row.get("finished")]
    seconds = float(log[-1]["seconds"]) if log else None
    return about(job) | measured | {"seconds": seconds}


def _measured(folder, header, metrics):
    """{metric: mean, "points", "device"} of an evaluation of this very checkpoint that has all
    metrics; None where there is none.
    """
    try:
        result = json.loads(read_json_text(folder.metrics("test"), MOST_METRICS))
        means = {name: float(result["mean"][name]) for name in metrics}
        whole = result["finished"] is True and result["step"] == header["step"]
        values = means | {"points": int(result["points"]["final"]), "device": result["device"]}
    except (OSError, ValueError, OverflowError, KeyError, TypeError, RecursionError):
        return None  # measured anew
    is_sound = isinstance(values["device"], str) and all(map(math.isfinite, means.values()))
    return values if whole and is_sound else None


def progress(job: Job) -> str:
    """How far the training is, in words, by its log."""
    rows = RunFolder(job.folder).rows()
    if not rows:
        return "beginning"
    if rows[-1].get("finished"):
        return "evaluating"
    psnr = rows[-1].get("psnr")
    shown = f", PSNR {psnr:.1f}" if isinstance(psnr, int | float) else ""
    return f"step {rows[-1]['step']} of {job.iterations}{shown}"
