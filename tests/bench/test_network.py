"""pp_cl/bench/network.py and bench_layer.py: every variant is right, its numbers are what they say,
bad input is one line.
"""

import json
import sys

import numpy as np
import pytest
from oracle.winograd import rounding_share

from pp_cl.bench import network as bench
from pp_cl.bench import peak
from pp_cl.bench.layer import DIRECTIONS, Layer
from pp_cl.bench.network import bench_conv, bench_unet, errors, flops_of, interleave, run_bench
from pp_cl.cli import main
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.layers.variants import offered
from pp_cl.network.unet import unet_steps

SMALL = ("--size", "8", "--widths", "16,16,16")
# relative L2 error of a layer with weights stored as half
HALF = {"winograd4_half": rounding_share(4)}
KEYS = {"variant", "direction", "shape", "ms", "gflops", "peak_share", "rel_l2", "max_err"}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Short runs, and few of them."""
    monkeypatch.setattr(peak, "SECONDS", 0.0)
    monkeypatch.setattr(bench, "SECONDS", 0.0)
    monkeypatch.setattr(bench, "LEAST_ROUNDS", 2)


@pytest.mark.parametrize(
    "k, sources, co, choice", [(3, (16, 48), 32, True), (3, (3,), 16, False), (1, (32,), 3, False)]
)
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_layer_is_compared_with_the_truth(dev, direction, k, sources, co, choice):
    layer = Layer(dev, k, 13, sources, co)
    assert layer.variants == (offered(dev) if choice else ["direct"])
    for variant in layer.variants:
        actual, expected = layer.result(variant, direction)
        assert actual.shape == expected.shape and expected.dtype == np.float64
        assert np.abs(expected).max() > 0.1
        assert errors(actual, expected)[0] < (
            HALF.get(variant, 1e-5) if direction != "weights" else 1e-5
        )


def test_rows_of_the_layers(dev):
    rows = bench_conv(dev, 8, (16, 16, 32))
    assert all(row.keys() >= KEYS for row in rows)
    assert {row["direction"] for row in rows} == {"forward", "input", "weights"}
    # enc0.b and dec0.b are one layer, as are enc1.b and dec1.b
    layers = [
        row["layer"] for row in rows if row["direction"] == "forward" and row["variant"] == "direct"
    ]
    assert layers == [
        "enc0.a",
        "enc1.a",
        "enc2.a",
        "enc2.b",
        "up1",
        "dec1.a",
        "up0",
        "dec0.a",
        "out",
    ]
    shapes = {row["layer"]: row["shape"] for row in rows}
    assert shapes["dec1.a"] == [4, 4, 32, 16, 3] and shapes["out"] == [8, 8, 16, 3, 1]
    for row in rows:
        assert row["rel_l2"] < HALF.get(row["variant"], 1e-5)
        assert row["peak_share"] == pytest.approx(row["gflops"] / row["peak_gflops"])
        height, width, ci, co, k = row["shape"]
        assert row["gflops"] == pytest.approx(2e-6 * k * k * ci * co * height * width / row["ms"])


@pytest.mark.parametrize("check_size", [8, 256])
def test_rows_of_the_network(dev, monkeypatch, check_size):
    monkeypatch.setattr(bench, "CHECK_SIZE", check_size)
    rows = bench_unet(dev, 16, (16, 16, 32))
    names = ["auto", *offered(dev)]
    assert [row["direction"] for row in rows] == ["forward"] * len(names) + ["train"] * len(names)
    assert [row["variant"] for row in rows] == names * 2
    for row in rows:
        assert row.keys() >= KEYS
        assert row["shape"] == [16, 16, 16, 16, 16, 32, 3]
        # ten layers
        assert 0 < row["rel_l2"] < 10 * HALF.get(row["variant"], 2e-6) and row["max_err"] > 0
    steps = unet_steps((16, 16, 32), 3)
    channels = {"x": 16} | {s.name: s.channels for s in steps}
    flops = sum(flops_of(s, channels, 16, 16) for s in steps if s.kind.startswith("conv"))
    assert rows[0]["gflops"] == pytest.approx(flops / rows[0]["ms"] * 1e-6)
    assert rows[-1]["gflops"] == pytest.approx(3 * flops / rows[-1]["ms"] * 1e-6)


def test_operations_of_the_papers_network():
    """The paper's network takes about 1.0 TMAC at 800x800."""
    steps = unet_steps((128, 256, 512), 3)
    channels = {"x": 16} | {s.name: s.channels for s in steps}
    flops = sum(flops_of(s, channels, 800, 800) for s in steps if s.kind.startswith("conv"))
    assert flops / 2 == pytest.approx(1.0e12, rel=0.1)


def test_runs_take_turns():
    calls = []
    times = interleave({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3)
    assert "".join(calls) == "ab" * 4  # the first round is not measured
    assert [len(t) for t in times.values()] == [3, 3]
    assert len(interleave({"a": lambda: None})["a"]) == bench.LEAST_ROUNDS


def test_errors_are_what_they_say_and_hide_no_nan():
    assert errors([3.0, 5.0], [3.0, 4.0]) == (0.2, 1.0)
    assert errors([0.0], [0.0]) == (0.0, 0.0)
    with pytest.raises(FloatingPointError):
        errors([np.nan], [1.0])


def test_files_and_table(tmp_path, capsys):
    files = tmp_path / "b.json", tmp_path / "b.png"
    pytest.importorskip("matplotlib", reason="the plot needs the extra `plot`")
    assert main(["bench", "conv", *SMALL, "--json", str(files[0]), "--plot", str(files[1])]) == 0
    result = json.loads(files[0].read_text())
    assert result["device"] and all(row.keys() >= KEYS for row in result["rows"])
    assert files[1].read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert printed.count("enc0.a") == 3 * len(offered(open_device())) and "GFLOP/s" in printed


@pytest.mark.parametrize(
    "words, named",
    [
        (("--size", "30"), "--size 30"),
        (("--size", "0"), "--size 0"),
        (("--size", "big"), "--size big"),
        (("--widths", "16,32"), "--widths 16,32"),
        (("--widths", "16,0,32"), "16,0,32"),
        (("--widths", "1,2,3,x"), "1,2,3,x"),
        (("--json", "/nowhere/b.json"), "--json /nowhere/b.json"),
        (("--plot", "/nowhere/b.png"), "--plot /nowhere/b.png"),
        (("--device", "abacus"), "abacus"),
    ],
)
def test_bad_input_is_one_line(words, named, capsys):
    assert main(["bench", "unet", *SMALL, *words]) == 2
    captured = capsys.readouterr()
    assert named in captured.err and captured.err.count("\n") == 1


def test_a_plot_needs_matplotlib_and_a_known_suffix(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="png"):
        pytest.importorskip("matplotlib", reason="the plot needs the extra `plot`")
        run_bench("conv", 8, (16, 16, 16), plot_file=tmp_path / "b.xyz")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pp-cl\\[plot\\]"):
        run_bench("conv", 8, (16, 16, 16), plot_file=tmp_path / "b.png")
