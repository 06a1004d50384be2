"""tools/compare_torch.py: PyTorch's twin is the same network, and the file holds what the tool
promises.
"""

import json
import sys

import numpy as np
import pytest
from support.comparisons import relative_error

from pp_cl.bench.unet import make_network, plain_parameters
from pp_cl.engine.layers.choice import AUTO, VARIANTS
from tools.compare_torch import TorchNetwork, main


@pytest.fixture
def torch():
    """PyTorch, or a skip."""
    return pytest.importorskip(
        "torch", reason="PyTorch is not installed: the development extra `torch`"
    )


@pytest.mark.parametrize("variant", [AUTO, *VARIANTS])
def test_the_twin_is_the_same_network(torch, dev, rng, variant):
    net = make_network(dev, (16, 32, 48), variant)
    x, grad_image = (
        rng.normal(size=(16, 16, 16)).astype(np.float32),
        rng.normal(size=(16, 16, 3)).astype(np.float32),
    )
    twin = TorchNetwork(torch, net, torch.float64)
    image = net.forward(dev.upload(x)).get()
    actual = {"x": net.backward(dev.upload(grad_image)).get()} | plain_parameters(
        net, net.gradients
    )
    expected = twin.train(twin.input(x), twin.input(grad_image).detach())
    assert relative_error(image, twin.forward(twin.input(x))[0].numpy().transpose(1, 2, 0)) < 1e-5
    assert relative_error(actual.pop("x"), expected.pop("x")[0].numpy().transpose(1, 2, 0)) < 1e-5
    assert actual.keys() == expected.keys()
    for name, gradient in actual.items():
        assert relative_error(gradient, expected[name].numpy()) < 1e-5, name


def test_the_file(torch, tmp_path, capsys):
    file = tmp_path / "t.json"
    words = ["--widths", "16,16,16", "--size", "8", "--runs", "3", "--threads", "1", "--json"]
    assert main([*words, str(file)]) == 0
    result = json.loads(file.read_text())
    assert 0 < result["rel_l2"] < 1e-5 and result["threads"] == 1
    for direction in ("forward", "train"):
        row = result[direction]
        assert row["ratio"] == pytest.approx(row["torch_ms"] / row["ours_ms"])
    assert "ratio" in capsys.readouterr().out


def test_without_torch_it_says_so(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    assert main(["--size", "8"]) == 2
    assert "pip install torch==2.13.0" in capsys.readouterr().err
    for words in (["--size", "9"], ["--runs", "0"]):
        with pytest.raises(SystemExit):
            main(words)
        assert words[0] in capsys.readouterr().err
