"""Planned runs of a sweep, and folders that look like trained and measured runs."""

import json

from support.checkpoints import contents
from support.runs import SETTINGS, set_words

from pp_cl.checkpoint import save_checkpoint
from pp_cl.config import run_config
from pp_cl.files.run_folder import RunFolder
from pp_studio.sweep.plan import plan

ITERATIONS = 16
SETS = SETTINGS | {
    "train.iterations": ITERATIONS,
    "train.checkpoint_every": 4,
    "scene.downscale": 2,
}
GIVEN = [(key, str(value), "--set") for key, value in SETS.items()]


def jobs_of(scenes, out, seeds=(0,), varied=None, **options):
    """The planned runs of a sweep with the small settings."""
    return plan([str(s) for s in scenes], out, seeds, varied or {}, **{"given": GIVEN} | options)


def words_of(scenes, out, *more, changes=None):
    """Command line of the same sweep; `changes` are made to its settings."""
    sets = set_words(SETS | (changes or {}))
    return ["sweep", *map(str, scenes), "--out", str(out), *sets, *map(str, more)]


def pretend(job, psnr, ssim=0.5, *, points=10, seconds=2.0, step=None, finished=True):
    """Write a run's folder as its training and evaluation would leave it."""
    folder = RunFolder(job.folder)
    config = run_config(folder, job.scene, job.preset, job.given)
    folder.create(config.to_json())
    save_checkpoint(
        folder.checkpoint, *contents(config, ITERATIONS if finished else ITERATIONS - 1, points)
    )
    with folder.open_log(0) as log:
        log.write({"step": ITERATIONS, "seconds": seconds, "finished": finished})
    folder.evaluation("test").mkdir()
    measured = {
        "mean": {"psnr": psnr, "ssim": ssim},
        "finished": finished,
        "step": ITERATIONS - (not finished) if step is None else step,
        "points": {"final": points},
        "device": "a device",
    }
    (folder.evaluation("test") / "metrics.json").write_text(json.dumps(measured))
