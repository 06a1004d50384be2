"""Cases of the layers: convolutions of every variant, pooling, upsampling, gate, tiles."""

from functools import cache, partial

import numpy as np

from pp_cl.bench.conv import Layer
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers import simple, tiles
from pp_cl.engine.layers.choice import OFFERED, VARIANTS, blocking_of, can_run
from pp_cl.engine.network.tile_plan import halve
from pp_cl.reference import lpips, network
from pp_cl.selftest.case import EPS, Case, Check, allowed, each, exact, relative

# (size, channels of each part of the input, channels out, side of the kernel). They have incomplete
# tiles, rows and work-groups, groups of one, two and four blocks of 16 channels, and split the
# gradient of the weights by tiles and by channels.
SHAPES = (
    ((1, 1), (16,), 16, 3),
    ((1, 31), (16,), 32, 3),
    ((31, 33), (16, 32), 48, 3),
    ((257, 3), (32,), 16, 3),
    ((8, 8), (512,), 32, 3),
    ((33, 97), (16,), 32, 3),
    ((9, 7), (144,), 48, 3),
    ((5, 6), (80,), 144, 3),
)
DIRECT_SHAPES = (
    *SHAPES,
    ((5, 31), (3,), 20, 3),
    ((5, 21), (36,), 64, 3),
    ((31, 33), (16, 32), 48, 1),
    ((1, 1), (3,), 3, 1),
)
# Shares of the largest value. The error of a sum of up to 4608 products, each rounded by half EPS,
# grows as the root of their number, to 4e-6; the largest of many values has more of it the longer
# the sum. Transforms of F(4x4) enlarge it. Sums in a gradient of weights are as long as the image.
BOUNDS = {"local": 3e-6, "direct": 3e-6, "winograd": 8e-6}
WEIGHTS_BOUND = 5e-6
# Share of the largest value: the transforms of F(4x4) add 36 numbers of a few times its size, and
# the error of a sum of 4608 products grows as the root of their number.
HARD_SHARE = 1e-5
ONE_COLOUR = "one colour"

PLANES = ((1, 1, 16), (1, 5, 3), (31, 33, 17), (3, 257, 32))  # (H, W, C)
FOUR = 4 * EPS  # means and interpolations of four values
GATED = 4 * EPS  # exp, expm1 and a division have errors of some units in the last place each
# for extreme gates: OpenCL allows exp and expm1 an error of three units each, and subnormals of
# float32 may become 0
EXTREME, SUBNORMAL = 3e-6, 1e-32


def _normal(rng, *shape):
    return rng.normal(size=shape).astype(np.float32)


@cache
def _layers():
    """[Layer] for DIRECT_SHAPES, which begin with SHAPES, computed once for all variants."""
    rng = np.random.default_rng(3)
    return [Layer.random(rng, *shape) for shape in DIRECT_SHAPES]


@cache
def _hard_layers():
    """{name: 3x3 convolution} with inputs or weights that are hard for float32 or Winograd."""
    rng = np.random.default_rng(7)

    def layer(x, weight, bias=None, grad_out=None):
        weight = np.asarray(weight, np.float32)
        bias = _normal(rng, len(weight)) if bias is None else bias
        grad_out = _normal(rng, *x.shape[:2], len(weight)) if grad_out is None else grad_out
        return Layer([x.astype(np.float32)], weight, bias, grad_out.astype(np.float32))

    x, weight = _normal(rng, 13, 17, 32), _normal(rng, 32, 32, 3, 3) / np.sqrt(np.float32(288))
    decades = 10 ** rng.uniform(-3, 3, 32)
    bright = np.zeros_like(x)
    bright[6, 8] = 1e3 * x[6, 8]
    limits = np.where(np.arange(32) % 2, 6e4, 1e-7)
    none = np.zeros(32, np.float32)
    return {
        "means of 1e3": layer(1e3 + x, weight),
        "means of 1e3, weights that sum to zero": layer(
            1e3 + x, weight - weight.mean((2, 3), keepdims=True)
        ),
        "weights over six decades, by input channel": layer(x, weight * decades[:, None, None]),
        "weights over six decades, one by one": layer(
            x, weight * 10 ** rng.uniform(-3, 3, weight.shape)
        ),
        "512 channels": layer(
            _normal(rng, 12, 12, 512), _normal(rng, 512, 512, 3, 3) / np.sqrt(4608)
        ),
        "background with one bright pixel": layer(bright, weight, none),
        "background alone": layer(np.zeros_like(x), weight, grad_out=np.zeros_like(x)),
        # a sum of equal numbers over the image, one by one, would lose three digits
        ONE_COLOUR: layer(
            np.full((64, 257, 16), 1.1), weight[:16, :16], grad_out=np.full((64, 257, 16), 0.7)
        ),
        "output channels of 6e4 and of 1e-7": layer(x, weight * limits[:, None, None, None]),
        "inputs and gradients of 6e4": layer(
            6e4 * np.sign(x), weight, grad_out=6e4 * np.sign(_normal(rng, *x.shape))
        ),
        "inputs and gradients of 1e-7": layer(
            1e-7 * x, weight, none, 1e-7 * _normal(rng, *x.shape)
        ),
    }


def within(actual: np.ndarray, expected: np.ndarray, naive: np.ndarray | None = None) -> Check:
    """A check of each value's error against HARD_SHARE of the largest value; in a feature map (H,
    W, C), of the largest in its channel.
    """
    most = HARD_SHARE * np.abs(expected).max((0, 1) if expected.ndim == 3 else None)
    return allowed(actual, expected, np.broadcast_to(most, expected.shape), naive=naive)


def _convolution(variant, dev, rng):
    """Output and all gradients, with awkward sizes, two sources and a masked gradient."""
    bound = BOUNDS[variant]
    layers = _layers() if can_run(variant, 1) else _layers()[: len(SHAPES)]
    for layer in layers:
        results = layer.computed(dev, variant, blocking_of(dev))
        for actual, expected in zip(results, layer.expected, strict=True):
            of_weights = expected.ndim != 3
            yield relative(actual, expected, max(bound, WEIGHTS_BOUND) if of_weights else bound)


def _hard_convolution(variant, dev, rng):
    """Large means, weights over six decades, values of 6e4 and 1e-7, 512 channels, zeros."""
    for name, layer in _hard_layers().items():
        results = layer.computed(dev, variant, blocking_of(dev))
        for actual, expected in zip(results, layer.expected, strict=True):
            is_bias = name == ONE_COLOUR and expected.ndim == 1
            naive = layer.grad_out.reshape(-1, len(expected)).cumsum(0)[-1] if is_bias else None
            yield within(actual, expected, naive)


def _pool(dev, rng):
    """Means of 2x2 pixels; the gradient is added, and masked where a ReLU was pooled."""
    for h, w, c in PLANES:
        x, other = np.maximum(_normal(rng, 2 * h, 2 * w, c), 0), _normal(rng, 2 * h, 2 * w, c)
        grad_out, out, device_x = _normal(rng, h, w, c), dev.empty((h, w, c)), dev.upload(x)
        simple.avgpool2_forward(dev, device_x, out)
        yield relative(out.get(), network.pool(x.astype(np.float64)), FOUR)
        added = other + network.pool_backward(grad_out.astype(np.float64))
        for mask, expected in ((device_x, added * (x > 0)), (None, added)):
            grad_x = dev.upload(other)
            simple.avgpool2_backward(dev, mask, dev.upload(grad_out), grad_x)
            yield relative(grad_x.get(), expected, FOUR)


def _max_pool(dev, rng):
    """Cells of zeros and of equal values; odd borders are dropped."""
    for shape in ((2, 2, 16), (3, 5, 3), (31, 33, 17), (257, 2, 32)):
        x = np.maximum(rng.integers(-3, 3, shape), 0).astype(np.float32)
        out = dev.empty((shape[0] // 2, shape[1] // 2, shape[2]))
        simple.maxpool2_forward(dev, dev.upload(x), out)
        yield exact(out.get(), lpips.maxpool2(x))


def _upsample(dev, rng):
    for h, w, c in PLANES:
        x, grad_out = _normal(rng, h, w, c), _normal(rng, 2 * h, 2 * w, c)
        out, grad_x = dev.empty(grad_out.shape), dev.empty(x.shape)
        simple.upsample2_forward(dev, dev.upload(x), out)
        yield relative(out.get(), network.upsample(x.astype(np.float64)), FOUR)
        simple.upsample2_backward(dev, dev.upload(grad_out), grad_x)
        # sums of up to 16 weighted values
        expected = network.upsample_backward(grad_out.astype(np.float64))
        yield relative(grad_x.get(), expected, 8 * EPS)


def _output(dev, rng):
    """Colours of the network's output, with features added and without, and the gradients."""
    for width in (1, 31, 33, 257):
        features, output = rng.standard_normal((3, width, 16)), rng.standard_normal((3, width, 3))
        image, plain = dev.upload(output, np.float32), dev.upload(output, np.float32)
        simple.output_forward(dev, image, dev.upload(features, np.float32))
        simple.output_forward(dev, plain, None)
        yield relative(plain.get(), 0.5 + 0.5 * output, 2 * EPS)
        yield relative(
            image.get(), 0.5 + 0.5 * output + simple.SHARE * (features[..., :3] - 1), 2 * EPS
        )
        grad_features = dev.upload(features, np.float32)
        simple.residual_backward(dev, dev.upload(output, np.float32), grad_features)
        expected = np.concatenate(
            [features[..., :3] + simple.SHARE * output, features[..., 3:]], axis=2
        )
        yield relative(grad_features.get(), expected, 2 * EPS)


def _first_features(dev, rng):
    """Features used as colours, and the gradient."""
    for height, width in ((1, 1), (31, 33), (3, 257)):
        features, grad = _normal(rng, height, width, 16), _normal(rng, height, width, 3)
        image, grad_features = dev.empty(grad.shape), dev.empty(features.shape)
        simple.first_features_forward(dev, dev.upload(features), image)
        yield relative(image.get(), features[..., :3].astype(np.float64), EPS)
        simple.first_features_backward(dev, dev.upload(grad), grad_features)
        expected = np.zeros(features.shape)
        expected[..., :3] = grad
        yield relative(grad_features.get(), expected, EPS)


def _gate(dev, rng):
    for h, w, c in PLANES:
        x, grad_out = 3 * _normal(rng, h, w, 2 * c), _normal(rng, h, w, c)
        out, grad_x = gated(dev, x, grad_out)
        exact_x, exact_grad = x.astype(np.float64), grad_out.astype(np.float64)
        yield relative(out, network.gate(exact_x), GATED)
        yield relative(grad_x, network.gate_backward(exact_x, exact_grad), GATED)


def _extreme_gate():
    """(1, N, 2) float32: all pairs of features and gates from 1e-12 to 60."""
    powers = 10.0 ** np.arange(-12, 2)
    values = [*-powers, 0, *powers, -40, 40, -60, 60]
    return np.stack(np.meshgrid(values, values), -1).reshape(1, -1, 2).astype(np.float32)


def _small_features(dev, rng):
    x = _extreme_gate()
    out, _ = gated(dev, x, np.ones_like(x[..., :1]))
    features, gates = np.split(x, 2, 2)
    naive = np.where(features > 0, features, np.exp(features) - 1) / (1 + np.exp(-gates))
    yield each(out, network.gate(x.astype(np.float64)), EXTREME, SUBNORMAL, naive=naive)


def _closed_gates(dev, rng):
    x = _extreme_gate()
    ones = np.ones_like(x[..., :1])
    _, grad_x = gated(dev, x, ones)
    features, gates = np.split(x, 2, 2)
    elu, open_ = np.where(features > 0, features, np.expm1(features)), 1 / (1 + np.exp(-gates))
    naive = np.concatenate([open_ * np.exp(np.minimum(features, 0)), elu * open_ * (1 - open_)], 2)
    expected = network.gate_backward(*(array.astype(np.float64) for array in (x, ones)))
    yield each(grad_x, expected, EXTREME, SUBNORMAL, naive=naive)


def gated(dev: Device, x: np.ndarray, grad_out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A gate's (output, gradient of x), computed by the device; x, grad_out: float32."""
    out, grad_x, device_x = dev.empty(grad_out.shape), dev.empty(x.shape), dev.upload(x)
    simple.gate_forward(dev, device_x, out)
    simple.gate_backward(dev, device_x, dev.upload(grad_out), grad_x)
    return out.get(), grad_x.get()


def _tiles(dev, rng):
    """Tiles that differ from the background, and copies of tiles, also at the border."""
    for h, w, c in ((1, 1, 1), (3, 5, 16), (31, 33, 3), (4, 257, 20), (257, 8, 16)):
        odd = rng.choice([0.0, np.nan, np.inf, 1 + EPS], (h, w, c))
        x = np.where(rng.random((h, w, c)) < 0.02, odd, 1).astype(np.float32)
        differing, naive = tiles.tiles_find(dev, dev.upload(x), 1.0).get(), np.abs(x - 1) > 0
        yield exact(differing, halve((x != 1).any(2), 2), naive=halve(naive.any(2), 2))
        yield _copied_tiles(dev, rng, _normal(rng, h, w, c))


def _copied_tiles(dev, rng, x):
    """Half of the tiles become copies of the first one of their shape."""
    rows, columns = tiles.grid_shape(*x.shape[:2])
    y, z = np.mgrid[: x.shape[0], : x.shape[1]]
    cut = (np.arange(rows) * tiles.MAP_TILE + tiles.MAP_TILE > len(x))[:, None] * 2
    cut = cut + (np.arange(columns) * tiles.MAP_TILE + tiles.MAP_TILE > x.shape[1])
    _, first, kind = np.unique(cut, return_index=True, return_inverse=True)
    source = first[kind.reshape(cut.shape)]
    number = np.arange(rows * columns).reshape(cut.shape)
    chosen = (rng.random(cut.shape) < 0.5) & (source != number)
    copies, array = tiles.copy_list(source, chosen), dev.upload(x)
    behind = np.full((3, 2), 2**30, np.int32)  # must not be read
    tiles.tiles_copy(dev, array, dev.upload(np.concatenate([copies, behind])), len(copies))
    tile = np.where(chosen, source, number)[y // tiles.MAP_TILE, z // tiles.MAP_TILE]
    expected = x[
        tile // columns * tiles.MAP_TILE + y % tiles.MAP_TILE,
        tile % columns * tiles.MAP_TILE + z % tiles.MAP_TILE,
    ]
    return exact(array.get(), expected)


# Variants for GPUs also run on CPUs, slowly; variants for CPUs might hang a GPU.
_ONLY = {name: None if name in OFFERED["GPU"] else name for name in VARIANTS}

CASES = (
    *(Case(f"conv: {v}", partial(_convolution, v), _ONLY[v]) for v in VARIANTS),
    *(
        Case(
            f"conv: {v}, hard inputs",
            partial(_hard_convolution, v),
            _ONLY[v],
            "16,448 equal pixels added one by one",
        )
        for v in VARIANTS
    ),
    Case("layers: mean pooling", _pool),
    Case("layers: max pooling", _max_pool),
    Case("layers: upsampling", _upsample),
    Case("layers: output", _output),
    Case("layers: features in place of a network", _first_features),
    Case("layers: gate", _gate),
    Case("layers: gate, features of 1e-12", _small_features, hard="exp(x) - 1 cancels"),
    Case("layers: gate, gates of 60", _closed_gates, hard="s (1 - s) is 0"),
    Case("layers: tiles", _tiles, hard="abs(x - background) > 0 misses NaN"),
)
