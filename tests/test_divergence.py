import json

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.refused import failure
from support.runs import arguments, rows

from pp_cl.engine.training.optim import Optimiser

SAVED = "checkpoint.npz of step 10 is kept: train into another --out with a lower network.rate"
# {case: (step after which NaN appears, in which array, other settings, part of the message)}
DIVERGENCES = {
    "points": (15, "points", {}, "the loss is not finite at step 16 (loss, l1, ssim, psnr)"),
    "preview": (20, "points", {"train__checkpoint_every": 10}, "holds NaN after step 20"),
    "measured": (15, "points", {"train__eval_every": 15}, "test/r_0.png holds NaN after step 15"),
    "checkpoint": (20, "moment", {}, "holds NaN or Inf"),
    "pruning": (20, "opacity", {}, "an opacity"),
}


@pytest.mark.parametrize("case", DIVERGENCES)
def test_a_training_that_diverges_keeps_its_last_good_checkpoint(
    scene, tmp_path, monkeypatch, case
):
    after, what, settings, words = DIVERGENCES[case]
    _poison(monkeypatch, after, what)
    monkeypatch.setattr("pp_cl.session.training.PREVIEWS", 3 if case == "preview" else 1)
    line = failure(*arguments(scene, tmp_path / "run", **settings))
    assert words in line and SAVED in line and str(tmp_path / "run") in line
    header, arrays = load_checkpoint(tmp_path / "run" / "checkpoint.npz")
    assert header["step"] == 10 and all(np.isfinite(a).all() for a in arrays.values())
    logged = rows(tmp_path / "run")
    assert logged[-1]["step"] in (10, 15, 20) and "NaN" not in json.dumps(logged)
    drawn = sorted(path.name for path in (tmp_path / "run" / "previews").glob("*.png"))
    assert drawn == [] or drawn[-1] <= "step_000015.png"


def _poison(monkeypatch, after, what):
    update, steps = Optimiser.update, []

    def poisoned(self, *args, **named):
        update(self, *args, **named)
        steps.append(0)
        if len(steps) == after:
            cloud = self.model.cloud
            arrays = {
                "points": cloud.sh[0],
                "opacity": cloud.opacity,
                "moment": self.moments["m"],
            }
            self.dev.fill(arrays[what], np.nan)

    monkeypatch.setattr(Optimiser, "update", poisoned)


def test_a_training_that_diverges_at_its_end_is_not_finished(scene, tmp_path, monkeypatch):
    """Averages would hide the NaN."""
    _poison(monkeypatch, 60, "moment")
    line = failure(*arguments(scene, tmp_path / "run"))
    assert "holds NaN or Inf; " in line and "checkpoint.npz of step 50 is kept" in line
    assert load_checkpoint(tmp_path / "run" / "checkpoint.npz")[0]["step"] == 50
    assert not any(row.get("finished") for row in rows(tmp_path / "run"))


def test_a_training_that_diverges_before_its_first_checkpoint(scene, tmp_path, monkeypatch):
    _poison(monkeypatch, 3, "points")
    error = failure(*arguments(scene, tmp_path / "run"))
    assert "at step 4 (loss, l1, ssim, psnr); nothing was kept: train into" in error
    assert not (tmp_path / "run" / "checkpoint.npz").exists()
