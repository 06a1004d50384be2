"""Reads a run's row of the sweep's table, and its progress, from the files in its folder."""

from typing import Any

from pp_cl.config import load_config
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.session import run_config
from pp_cl.sweep.plan import Job
from pp_cl.training.checkpoint import opened_run


def _about(job):
    """What a row says of any run."""
    return {
        "scene": job.name,
        "settings": dict(job.varied),
        "seed": job.seed,
        "folder": job.folder,
    }


def failed_row(job: Job, error: str) -> dict[str, Any]:
    """The row of a run that failed: "scene", "settings", "seed", "folder" and "error", one line."""
    return _about(job) | {"error": error}


def finished_row(job: Job) -> dict[str, Any] | None:
    """The row of a run that is trained and evaluated: "scene", "settings", "seed", "folder", its
    metrics, "points", "seconds" of training (None where the log is lost) and "device"; else None.

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
    try:
        result = folder.measured()
    except UserError:
        return None  # is measured again
    if not (result and result["finished"] and result["step"] == header["step"]):
        return None
    if not (header["finished"] and {*job.metrics} <= result["mean"].keys()):
        return None
    log = [row for row in folder.rows() if row.get("finished")]
    means = {name: result["mean"][name] for name in job.metrics}
    return (
        _about(job)
        | means
        | {"points": result["points"], "device": result["device"]}
        | {"seconds": log[-1]["seconds"] if log else None}
    )


def progress(job: Job) -> str:
    """How far the training is, in words, by its log."""
    rows = RunFolder(job.folder).rows()
    if not rows:
        return "beginning"
    if rows[-1].get("finished"):
        return "evaluating"
    psnr = f", PSNR {rows[-1]['psnr']:.1f}" if "psnr" in rows[-1] else ""
    steps = f" of {job.iterations}" if job.iterations else ""
    return f"step {rows[-1]['step']}{steps}{psnr}"
