"""A run's row in the table of a sweep, read from the files in its folder."""

from typing import Any

from pp_cl import RunFolder
from pp_cl.config import load_config, refuse_setting, run_config
from pp_cl.errors import UserError
from pp_studio.sweep.plan import Job


def _about(job):
    """What a row says of any run."""
    return {"scene": job.name, "settings": job.varied, "seed": job.seed, "folder": job.folder}


def failed_row(job: Job, error: str) -> dict[str, Any]:
    """The row of a run that failed: "scene", "settings", "seed", "folder" and "error", one line."""
    return _about(job) | {"error": error}


def finished_row(job: Job) -> dict[str, Any] | None:
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
    means = {name: result["mean"][name] for name in job.metrics}
    measured = {"points": result["points"], "device": result["device"]}
    return _about(job) | means | measured | {"seconds": seconds[-1] if seconds else None}
