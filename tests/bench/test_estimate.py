"""pp_cl/bench/estimate.py: launches are those of a step, bytes and multiply-adds as by hand."""

from collections import Counter
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import write_ball_scene

from pp_cl.bench import estimate
from pp_cl.bench.estimate import Card, Counts, Work, measured_card, report, step_work
from pp_cl.config import assign, configure, preset
from pp_cl.device.device import Device
from pp_cl.device.launch import Program
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import open_training

N, P, S = 1000, 5000, 400
COUNTS = Counts(N, P, S, 64, 32)
SMALL = {
    "points.count": 700,  # of which the sums need two levels
    "network.widths": (16, 16, 16),
    "train.iterations": 1000,
    "train.sh_delay": (0.0, 0.0, 0.0),
    "train.sh_smoothing": 0.0,
    "train.ema": False,
}


@pytest.fixture
def launches(monkeypatch):
    """Counter of kernels launched by stage."""
    stages, counted = [None], Counter()
    stage, launch = Device.stage, Program.launch

    @contextmanager
    def named(self, name):
        stages.append(name)
        with stage(self, name):
            yield
        stages.pop()

    def counting(self, *args, **arguments):
        counted[stages[-1]] += 1
        return launch(self, *args, **arguments)

    monkeypatch.setattr(Device, "stage", named)
    monkeypatch.setattr(Program, "launch", counting)
    return counted


@pytest.mark.parametrize(
    "name, pairs", [("paper", 4000), pytest.param("tiny", 5000, marks=pytest.mark.slow)]
)
def test_the_launches_of_a_step_on_a_gpu(dev, tmp_path, monkeypatch, launches, *, name, pairs):
    """pairs: whether there may be lists that are sorted in two passes more."""
    monkeypatch.setattr(dev, "is_cpu", False)
    scene = write_ball_scene(tmp_path / "ball")
    config = configure(preset(name), scene, [(k, v, "test") for k, v in SMALL.items()])
    trainer = open_training(dev, RunFolder(tmp_path / "run"), config, None).trainer
    trainer.train_step()
    launches.clear()
    trainer.train_step()
    # the padded image of the step
    _, (_, _, width, height), _ = trainer.draw(np.random.default_rng(0))
    counts = Counts(trainer.model.cloud.count, pairs, S, height, width)
    expected = {stage: work.launches for stage, work in step_work(config, counts).items()}
    del launches[None]  # the tiles that hold any points, of which no stage is
    assert dict(launches) == expected


def test_the_network_does_what_its_shapes_say():
    counts = Counts(N, P, S, 800, 800)
    paper = step_work(preset("paper"), counts)
    pixels = 800 * 800
    # 3x3 convolutions by level and 1x1 ones, worked out by hand
    full = 9 * (16 * 128 + 128 * 128 + 256 * 128 + 128 * 128) + 128 * 3
    half = 9 * (128 * 256 + 256 * 256 + 512 * 256 + 256 * 256) + 256 * 128
    quarter = 9 * (256 * 512 + 512 * 512) + 512 * 256
    expected = pixels * full + pixels // 4 * half + pixels // 16 * quarter
    assert paper["network"].multiply_adds == expected
    assert paper["network backward"].multiply_adds == 2 * expected
    sparse = step_work(preset("paper"), replace(counts, computed=0.25))
    assert sparse["network"].multiply_adds == expected / 4
    # all but the parameters and the image is in proportion
    kept = 4 * sparse["network"].bytes - paper["network"].bytes
    biases = (4 + 1) * 128 + (4 + 1) * 256 + 2 * 512 + 16
    parameters = full + half + quarter + 128 * (16 - 3) + biases  # 3 output channels take 16
    assert kept == pytest.approx(3 * (4 * parameters + 24 * pixels))


def test_a_point_moves_these_bytes():
    config = preset("paper")
    assign(config, "network.widths", (16, 16, 16), "test")
    update = [
        step_work(config, replace(COUNTS, points=n, shaded=s))["update"].bytes
        for n, s in ((N, S), (2 * N, S), (N, 2 * S))
    ]
    # the opacity and its two moments, read and written, and its gradient
    assert update[1] - update[0] == N * (2 * 3 * 4 + 4)
    # of a shaded one: nine rows of coefficients and one of their moment, read and written; its
    # gradient and its index, both twice; its last step, read and written; its vertex
    assert update[2] - update[0] == S * (2 * 9 * 64 + 2 * 64 + 2 * (64 + 4) + 2 * 4 + 4)


def test_the_rasteriser_moves_these_bytes():
    work = step_work(preset("paper"), COUNTS)
    assert work["project"].bytes == N * (4 + 16 + 8 + 4)
    assert work["shade"].bytes == S * (4 + 16 + 10 * 64)
    assert work["blend"].bytes == P * (8 + 64) + 64 * 32 * (4 + 64)
    assert all(w.bytes > 0 and w.launches > 0 for w in work.values())


@pytest.mark.parametrize(
    "work, seconds",
    [
        (Work(2e9, 1e9, 0), 2.0),
        (Work(1e9, 3e9, 0), 3.0),
        (Work(0, 0, 200), 1e-3),
        (Work(2e9, 0, 200), 2.001),
    ],
)
def test_the_longer_of_both_and_the_launches(work, seconds):
    assert Card(1e9, 2e9).seconds(work) == pytest.approx(seconds)


def test_a_report_is_a_table_to_paste(dev, monkeypatch):
    monkeypatch.setattr(estimate, "measured_card", lambda dev: Card(1e9, 1e12))
    lines = report(dev, preset("tiny"), COUNTS, {"project": 0.25, "smooth": 3.0})
    assert dev.name in lines[0] and " 1 GB/s" in lines[0] and "1000 GFLOP/s" in lines[0]
    assert "tiny, 1000 points, 5000 hits and 400 shaded points in 32x64 pixels" in lines[1]
    # 32 bytes a point at 1 GB/s, and a launch
    assert lines[-2:] == ["| project | 0.25 | 0.037 |", "| smooth | 3 |  |"]


def test_the_rates_are_measured(dev, monkeypatch):
    monkeypatch.setattr("pp_cl.bench.peak.COPY_BYTES", 2**16)
    monkeypatch.setattr("pp_cl.bench.peak.SECONDS", 0.0)
    ms = {"copy": [4.0, 2.0, 3.0], "peak": [0.5, 1.0]}
    monkeypatch.setattr(estimate, "interleave", lambda runs: ms)
    card = measured_card(dev)
    assert card.bandwidth == pytest.approx(2 * 2**16 / 2e-3)
    assert card.flops == pytest.approx(estimate.PeakFlops(dev).flops / 0.5e-3)
