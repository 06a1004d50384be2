"""pp_cl/bench/unet.py and the command: every variant is right, its numbers are what they say, bad
input is one line.
"""

import json
import sys

import pytest
from support.benches import KEYS

from pp_cl.bench import unet
from pp_cl.cli import main
from pp_cl.device.discover import open_device
from pp_cl.layers.choice import device_class, make_policy, offered
from pp_cl.network.layers import multiplications, unet_layers

SMALL = ("--size", "8", "--widths", "16,16,16")
pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize(
    "check_size, blocks", [(8, "double"), (256, "double"), (8, "single"), (8, "gated")]
)
def test_rows_of_the_network(dev, monkeypatch, check_size, blocks):
    monkeypatch.setattr(unet, "CHECK_SIZE", check_size)
    rows = list(unet.bench_unet(dev, 16, (16, 16, 32), make_policy(dev), blocks=blocks))
    names = ["auto", *offered(device_class(dev))]
    assert [row["direction"] for row in rows] == ["forward"] * len(names) + ["train"] * len(names)
    assert [row["variant"] for row in rows] == names * 2
    for row in rows:
        assert row.keys() >= KEYS
        assert row["shape"] == [16, 16, 16, 16, 16, 32, 3] and row["blocks"] == blocks
        # ten layers
        assert 0 < row["rel_l2"] < 10 * 2e-6 and row["max_err"] > 0
    flops = 2 * multiplications(unet_layers((16, 16, 32), blocks=blocks), 16, 16)
    assert rows[0]["gflops"] == pytest.approx(flops / rows[0]["ms"] * 1e-6)
    assert rows[-1]["gflops"] == pytest.approx(3 * flops / rows[-1]["ms"] * 1e-6)


def test_operations_of_the_papers_network():
    """The paper's network takes about 1.0 TMAC at 800x800."""
    counted = multiplications(unet_layers((128, 256, 512)), 800, 800)
    assert counted == pytest.approx(1.0e12, rel=0.1)


def test_files_and_table(tmp_path, capsys):
    files = tmp_path / "b.json", tmp_path / "b.png"
    pytest.importorskip("matplotlib", reason="the plot needs the extra `plot`")
    assert main(["bench", "conv", *SMALL, "--json", str(files[0]), "--plot", str(files[1])]) == 0
    result = json.loads(files[0].read_text())
    assert result["device"] and all(row.keys() >= KEYS for row in result["rows"])
    assert files[1].read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert (
        printed.count("enc0.a") == 3 * len(offered(device_class(open_device())))
        and "GFLOP/s" in printed
    )


@pytest.mark.parametrize(
    "words, named",
    [
        (("--size", "30"), "--size"),
        (("--size", "0"), "--size"),
        (("--size", "big"), "--size"),
        (("--widths", "16,32"), "--widths"),
        (("--widths", "16,0,32"), "--widths"),
        (("--widths", "1,2,3,x"), "--widths"),
        (("--blocks", "triple"), "double, single, gated"),
        (("--json", "/nowhere/b.json"), "--json"),
        (("--plot", "/nowhere/b.png"), "--plot"),
        (("--device", "abacus"), "abacus"),
    ],
)
def test_bad_input_is_one_line(words, named, capsys):
    assert main(["bench", "unet", *SMALL, *words]) == 2
    captured = capsys.readouterr()
    assert named in captured.err and captured.err.count("\n") == 1


def test_a_plot_needs_matplotlib_and_a_known_suffix(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="the plot needs the extra `plot`")
    assert main(["bench", "conv", *SMALL, "--plot", str(tmp_path / "b.xyz")]) == 2
    assert "png" in capsys.readouterr().err


def test_without_matplotlib_a_plot_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main(["bench", "conv", *SMALL, "--plot", str(tmp_path / "b.png")]) == 2
    assert "pp-cl[plot]" in capsys.readouterr().err
