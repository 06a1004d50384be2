"""The same network in pp-cl and in PyTorch: times in turn, and the error against float64.

    python tools/compare_torch.py --widths 128,256,512 --size 256 --json FILE

PyTorch (development extra `torch`) runs the same operations in the same order, in channels_last: on
the CPU or, if pp-cl uses a GPU, by CUDA, in float32 without TF32.
"""

import argparse
import sys

import numpy as np

from pp_cl.bench import unet as bench
from pp_cl.bench.timing import errors, interleave
from pp_cl.commands.options import integer, widths
from pp_cl.drivers import open_device
from pp_cl.engine.layers.choice import AUTO, VARIANTS
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json

# Seconds before each timed call. After PyTorch is done, OpenMP's threads spin for some milliseconds
# on cores that our device's threads need.
PAUSE = 0.03


class TorchNetwork:
    """PyTorch's twin of a UNet: the same parameters, in channels_last, with a dtype and on a
    device of PyTorch.
    """

    def __init__(self, torch, net, dtype, place):
        self.torch, self.dtype, self.place, self.layers = torch, dtype, place, net.layers
        plain = bench.plain_parameters(net, net.parameters)
        self.parameters = {name: self._tensor(values) for name, values in plain.items()}

    def _tensor(self, values):
        tensor = self.torch.from_numpy(np.array(values)).to(self.place, self.dtype)
        if tensor.ndim == 4:
            tensor = tensor.contiguous(memory_format=self.torch.channels_last)
        return tensor.requires_grad_()

    def input(self, values):
        """An (H, W, C) array as a (1, C, H, W) tensor."""
        return self._tensor(values[None].transpose(0, 3, 1, 2))

    def image(self, x):
        """The image (1, 3, H, W) of the features x (1, C, H, W)."""
        functional, outputs = self.torch.nn.functional, {"x": x}
        for layer in self.layers:
            source = outputs[layer.inputs[0]]
            if len(layer.inputs) > 1:
                source = self.torch.cat([outputs[name] for name in layer.inputs], 1)
            if layer.kind == "conv":
                weight = self.parameters[layer.name + ".weight"]
                bias = self.parameters[layer.name + ".bias"]
                out = functional.conv2d(source, weight, bias, padding=layer.kernel_size // 2)
                if layer.relu:
                    out = functional.relu(out, inplace=True)
            elif layer.kind == "pool":
                out = functional.avg_pool2d(source, 2)
            else:
                out = functional.interpolate(
                    source, scale_factor=2, mode="bilinear", align_corners=False
                )
            outputs[layer.name] = out
        return 0.5 + 0.5 * outputs["out"]

    def forward(self, x):
        """The finished image; nothing is kept for a backward pass."""
        with self.torch.inference_mode():
            image = self.image(x)
        self.finish()
        return image

    def train(self, x, grad_image):
        """Compute the image and all gradients, and wait."""
        self.torch.autograd.grad(self.image(x), [x, *self.parameters.values()], grad_image)
        self.finish()

    def finish(self):
        """Wait for the device."""
        if self.place == "cuda":
            self.torch.cuda.synchronize()


def compare(torch, dev, widths, size, *, variant, rounds):
    """{"rel_l2": our error against float64, "forward": {"ours_ms", "torch_ms", "ratio"}, "train":
    the same for forward and backward to input and weights}: medians, ratio = torch_ms / ours_ms.
    Raises UserError if pp-cl uses a GPU and PyTorch sees none.
    """
    place, how = "cpu", f"oneDNN, {torch.get_num_threads()} threads"
    if not dev.is_cpu:
        if not torch.cuda.is_available():
            raise UserError(f"PyTorch {torch.__version__} sees no GPU: install it with CUDA")
        place, how = "cuda", "cuDNN's fastest, without TF32"
        torch.backends.cudnn.conv.fp32_precision = "ieee"
        torch.backends.cudnn.benchmark = True
    rng = np.random.default_rng(0)
    values = np.maximum(rng.normal(size=(size, size, bench.CHANNELS_IN)), 0).astype(np.float32)
    grads = rng.normal(size=(size, size, bench.CHANNELS_OUT)).astype(np.float32)
    net = bench.make_network(dev, widths, variant)
    x, grad_image = dev.upload(values), dev.upload(grads)
    twin = TorchNetwork(torch, net, torch.float32, place)
    exact = TorchNetwork(torch, net, torch.float64, "cpu")
    torch_x, torch_grad = twin.input(values), twin.input(grads).detach()
    expected = exact.forward(exact.input(values)).numpy()[0].transpose(1, 2, 0)
    images = {
        "rel_l2": net.forward(x, training=False).get(),
        "torch_rel_l2": twin.forward(torch_x).cpu().numpy()[0].transpose(1, 2, 0),
    }
    times = interleave(
        {
            ("forward", "ours"): bench.network_runner(net, x),
            ("forward", "torch"): lambda: twin.forward(torch_x),
            ("train", "ours"): bench.network_runner(net, x, grad_image),
            ("train", "torch"): lambda: twin.train(torch_x, torch_grad),
        },
        rounds,
        PAUSE,
    )
    return {
        "device": dev.name,
        "platform": dev.info["platform"],
        "variant": variant,
        "torch": f"PyTorch {torch.__version__} ({how})",
        "widths": list(widths),
        "size": size,
        "runs": rounds,
        **{name: errors(image, expected)[0] for name, image in images.items()},
        **{direction: _summary(times, direction) for direction in ("forward", "train")},
    }


def _summary(times, direction):
    """Medians and quartiles of both, and PyTorch's time over ours."""
    summary = {}
    for name in ("ours", "torch"):
        low, median, high = np.percentile(times[direction, name], (25, 50, 75))
        summary |= {f"{name}_ms": float(median), f"{name}_quartiles": [float(low), float(high)]}
    return summary | {"ratio": summary["torch_ms"] / summary["ours_ms"]}


def main(argv: list[str] | None = None) -> int:
    """Measure, print and write the results; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add, count = parser.add_argument, integer(1, 10_000)
    add("--widths", default="128,256,512", type=widths, metavar="A,B,C", help="of the levels")
    add(
        "--size",
        default="256",
        type=integer(4, 4096, 4),
        metavar="S",
        help="of the image, a multiple of 4 (256)",
    )
    add("--variant", choices=(AUTO, *VARIANTS), default="auto", help="of our convolutions (auto)")
    add("--threads", type=count, default=2, metavar="N", help="PyTorch's (2)")
    add("--runs", type=count, default=15, metavar="N", help="timed runs of each (15)")
    add("--device", metavar="D", help="ours, as `pp-cl devices` prints them")
    add("--json", metavar="FILE", help="also write the result there")
    options = parser.parse_args(argv)
    try:
        import torch
    except ImportError:
        print("compare_torch: install PyTorch: `pip install torch==2.13.0`", file=sys.stderr)
        return 2
    torch.set_num_threads(options.threads)
    try:
        result = compare(
            torch,
            open_device(options.device),
            options.widths,
            options.size,
            variant=options.variant,
            rounds=options.runs,
        )
        if options.json:
            write_json(options.json, result)
    except UserError as error:
        print(f"compare_torch: {error}", file=sys.stderr)
        return 2
    print(f"relative L2 error: ours {result['rel_l2']:.1e}, PyTorch's {result['torch_rel_l2']:.1e}")
    for direction in ("forward", "train"):
        row = result[direction]
        print(
            f"{direction:8} ours {row['ours_ms']:9.2f} ms, PyTorch {row['torch_ms']:9.2f} ms, ratio"
            f" {row['ratio']:.2f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
