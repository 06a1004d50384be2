"""A flipped sign or comparison in any kernel file fails its case, and so does a naive formula in
place of a stable one. Each test builds kernels of its own: run `make test-slow` nightly and after
changes of cl/. Faults in a kernel also fail the cases themselves (test_cases.py).
"""

import shutil

import pytest

from pp_cl.engine.device import device as device_module
from pp_cl.engine.device.device import Program
from pp_cl.selftest.run import CASES, run_cases

KERNELS = device_module.kernel_folder()
# (kernel file, text that stands in it once, its replacement, the case that must fail)
FLIPS = [
    ("device/rows", "to[c] = from[c]", "to[c] = -from[c]", "device: compact and gather rows"),
    ("device/scan", "sum += total", "sum -= total", "device: scan"),
    ("device/nonzero", "before] = i", "before] = n", "device: list of non-zero values"),
    ("scene/demo", "y[lane] = grid[1]", "y[lane] = -grid[1]", "scene: demo"),
    ("scene/lens", "c - out[x]", "c + out[x]", "scene: lens"),
    ("scene/lens", "c - *at", "c + *at", "scene: lens"),
    ("scene/lens", "2.0f * p2 * xy", "-2.0f * p2 * xy", "scene: lens"),
    ("scene/hull", "counts & ~(in", "counts & (in", "scene: hull"),
    ("training/target", "255 * (255 - c.w)", "255 * (255 + c.w)", "scene: target"),
    ("training/target_between", "a * b / 4", "a - b / 4", "scene: target between pixels"),
    ("raster/project.h", "vx + cam->forward.y", "vx - cam->forward.y", "raster: project"),
    ("raster/footprint/round.h", "across2 < reach2", "across2 > reach2", "raster: pairs, disc"),
    ("raster/footprint/round.h", "1.0f - at.rest", "1.0f + at.rest", "raster: pairs, soft"),
    ("raster/footprint/soft.h", "sums[1] -= u", "sums[1] += u", "alpha: offsets of points"),
    ("raster/footprint/gaussian.h", "(wide + least", "(wide - least", "alpha: shapes of Gaussians"),
    ("raster/project", "seen += basis[k]", "seen -= basis[k]", "raster: opacities by direction"),
    ("raster/pairs", "as_uint(DEPTH", "as_uint(-DEPTH", "raster: pairs, soft"),
    ("raster/pairs", "shift < bits", "shift > bits", "raster: thousands of equal depths"),
    ("raster/lists_by_key", "[middle] < k", "[middle] > k", "raster: thousands of equal depths"),
    ("raster/shade", "features += basis[4 + b]", "features -= basis[4 + b]", "raster: shade"),
    ("raster/depth", "depth[own] += b", "depth[own] -= b", "raster: depth, softmax"),
    ("raster/depth", "+ share * (z", "- share * (z", "raster: depth, alpha"),
    ("raster/depth", "nearest + voxel", "nearest - voxel", "raster: depth of samples"),
    ("raster/highest_weights", "of_pair += w", "of_pair -= w", "raster: highest weights, alpha"),
    ("raster/gather", "sum += pair", "sum -= pair", "raster: highest weights, alpha"),
    ("raster/compositing.h", ", M), 0.0f", ", -M), 0.0f", "softmax: forward, disc"),
    ("raster/compositing.h", "= 1.0f - alpha", "= 1.0f + alpha", "alpha: forward, soft"),
    ("raster/weights", "(k)] / SAMPLES;\n", "(k)] * SAMPLES;\n", "alpha: samples of a pixel"),
    ("raster/weights", "nearest + range[", "nearest - range[", "alpha: forward, soft"),
    ("raster/softmax", "D[own] *= exp", "D[own] /= exp", "softmax: forward, soft"),
    ("raster/softmax", "[own]) <= tracked", "[own]) >= tracked", "softmax: backward, soft"),
    ("raster/blend", " + transmittance[q]", " - transmittance[q]", "softmax: forward, soft"),
    ("raster/blend", "(1.0f + a) * dL_db", "(1.0f - a) * dL_db", "softmax: backward, soft"),
    ("raster/blend", "&g, own) - behind", "&g, own) + behind", "alpha: backward, disc"),
    ("raster/blend", "after * inverse(", "after / inverse(", "alpha: backward, soft"),
    ("raster/gradients.h", "one = g->of_alpha", "one = -g->of_alpha", "alpha: gradient of alpha"),
    ("raster/blend", "before - after", "before + after", "alpha: samples of a pixel"),
    ("raster/blend", "before - after", "before + after", "alpha: distortion loss"),
    ("raster/blend", "loss += b * dist", "loss -= b * dist", "alpha: distortion loss"),
    ("raster/gradients.h", "(range - g->mean", "(range + g->mean", "alpha: depth loss"),
    ("raster/gather", "dL_df += load", "dL_df -= load", "alpha: backward, soft"),
    ("raster/fragments", "= weight[", "= -weight[", "alpha: forward, soft"),
    ("training/depth_loss", "here - after", "here + after", "alpha: depth loss"),
    ("layers/conv", "bias, relu", "bias, !relu", "conv: direct, hard inputs"),
    ("layers/direct.h", "[p] += value", "[p] -= value", "conv: direct, hard inputs"),
    ("layers/conv_backward", "[i] += value", "[i] -= value", "conv: direct, hard inputs"),
    ("layers/conv_local", "+ p] += v", "+ p] -= v", "conv: local, hard inputs"),
    ("layers/conv_local_backward_weights", "[0] += v", "[0] -= v", "conv: local, hard inputs"),
    ("layers/winograd", "bias, relu", "bias, !relu", "conv: winograd, hard inputs"),
    ("layers/winograd.h", "[i] += value", "[i] -= value", "conv: winograd, hard inputs"),
    ("layers/winograd_backward", "[i] += v", "[i] -= v", "conv: winograd, hard inputs"),
    ("layers/weights", ": vload16((rest", ": -vload16((rest", "conv: winograd"),
    ("layers/sum_parts", "found.sum, f", "-found.sum, f", "conv: direct, hard inputs"),
    ("layers/maxpool", "(a >= b)", "(a <= b)", "layers: max pooling"),
    ("layers/resample", "+ 0.25f * line", "- 0.25f * line", "layers: upsampling"),
    ("layers/resample", "+ 0.25f * dL_dout", "- 0.25f * dL_dout", "layers: mean pooling"),
    ("layers/output", "c] - BACK", "c] + BACK", "layers: output"),
    ("layers/first_features", "c < 3 ?", "c < 2 ?", "layers: features in place of a network"),
    ("layers/gate", "(open * closed)", "(open + closed)", "layers: gate"),
    ("layers/tiles", "line[i] != background", "line[i] == background", "layers: tiles"),
    ("training/loss", "e + derivative_0", "e - derivative_0", "loss: L1 and SSIM"),
    ("training/loss", "1.0f - transmittance", "1.0f + transmittance", "loss: mask"),
    ("training/ignored", "= -1.0f;", "= +1.0f;", "loss: ignored pixels"),
    ("training/exposure", "b[c][c] += prior", "b[c][c] -= prior", "loss: exposure"),
    ("training/exposure_undo", "(r, gb) + white", "(r, gb) - white", "loss: exposure"),
    ("training/exposure", "m[i] -= a[k][i]", "m[i] += a[k][i]", "loss: colours of a view"),
    ("training/adam", "(g - m_new)", "(g + m_new)", "adam: arrays"),
    ("training/adam", "- rate * m_new", "+ rate * m_new", "adam: gradients of 0, 1e-20 and 1e10"),
    ("training/ema", "a + weight", "a - weight", "training: moving average"),
    ("training/rmsprop", "- rate * basis", "+ rate * basis", "rmsprop: degree 2"),
    ("training/rmsprop", "k < 4 ? 1.0f", "k < 3 ? 1.0f", "rmsprop: degree 2"),
    ("training/rmsprop", ": seen <= 0.0f", ": seen <= 2.0f", "rmsprop: degree 2"),
    ("training/smooth", "* k + c) - f", "* k + c) + f", "training: smoothing"),
    ("training/refine", "1.0f + sqrt", "1.0f - sqrt", "training: split opacities"),
    ("layers/specular", "d += w.w", "d -= w.w", "specular: layer of an image"),
    ("layers/specular.h", "1.0f - 2.0f", "1.0f + 2.0f", "specular: layer of an image"),
    ("training/specular", "(wanted - v", "(wanted + v", "specular: pixels that it is fitted to"),
    ("metrics/lpips", "* scale_a - load_part", "* scale_a + load_part", "metrics: LPIPS"),
    ("metrics/shape", "at.x + 0.5f", "at.x - 0.5f", "metrics: vertices on a box"),
]  # fmt: skip
# here the replacement is a naive formula, which a hard case must detect
NAIVE = [
    ("raster/footprint/round.h", "FMA(at.z, at.z, 1e-30f)", "at.z * at.z",
     "alpha: a point on the ray"),
    ("raster/compositing.h", "select(through, (floats)(LEAST_THROUGH), through < LEAST_THROUGH)",
     "through", "alpha: an opaque fragment"),
    ("raster/footprint/gaussian.h", "sqrt(wide + v * (xx + yy) + v * v)",
     "sqrt((xx + v) * (yy + v) - xy * xy)", "alpha: needles"),
    ("raster/compositing.h", "exp(fmin(-fma((floats)(-o_z), (floats)(sharpness), M), 0.0f))",
     "exp((floats)(o_z * sharpness))", "softmax: gamma of 1e-5"),
    ("raster/depth", "select(missing, depth[own] / alpha[own], is_there)",
     "depth[own] / alpha[own]", "raster: depth of nothing"),
    ("layers/gate", "expm1(negative_part(x))", "exp(negative_part(x)) - 1.0f",
     "layers: gate, features of 1e-12"),
    ("layers/gate", "(open * closed)", "(open * (1.0f - open))", "layers: gate, gates of 60"),
    ("layers/tiles", "line[i] != background", "fabs(line[i] - background) > 0.0f", "layers: tiles"),
    ("training/loss", "#define SUM_SHIFT 1.0f", "#define SUM_SHIFT 0.0f", "loss: flat images"),
    ("training/exposure", "a[i][i] += prior", "a[i][i] += 0.0f", "loss: exposure"),
    ("training/adam", "BOUNDED_GRADIENT(floats, found.sum)", "found.sum",
     "adam: gradients of 1e30"),
    ("training/rmsprop", "BOUNDED_GRADIENT(floats, load_part(grad_visible_features, g))",
     "load_part(grad_visible_features, g)", "rmsprop: gradients of 1e30"),
    ("training/smooth", "fmax(weight, 1.0f)", "weight", "training: smoothing"),
    ("metrics/lpips", "#define EPSILON 1e-10f", "#define EPSILON 0.0f",
     "metrics: distance of LPIPS"),
]  # fmt: skip


def test_every_text_stands_once_in_its_file():
    planted = [*FLIPS, *NAIVE]
    assert [fault for fault in planted if path_of(fault[0]).read_text().count(fault[1]) != 1] == []
    assert [flip for flip in FLIPS if abs(len(flip[1]) - len(flip[2])) > 1] == []


def path_of(file):
    path = KERNELS / f"{file}.cl"
    return path if path.exists() else KERNELS / file


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, text, flipped, name", [*FLIPS, *NAIVE], ids=lambda v: v.replace("/", ".")
)
def test_a_fault_fails_its_case(dev, tmp_path, monkeypatch, file, text, flipped, name):
    case = next(case for case in CASES if case.name == name)
    monkeypatch.setattr(dev, "is_cpu", acts_as_cpu(dev, file, text))
    assert [row.passed for row in run_cases(dev, [case])] == [True]
    if path_of(file) == KERNELS / file:  # a header, included by its folder's kernels
        folder = shutil.copytree(KERNELS, tmp_path / "cl")
        (folder / file).write_text((folder / file).read_text().replace(text, flipped))
        monkeypatch.setattr(device_module, "kernel_folder", lambda: folder)
        wing = file.split("/")[0]
        others = {k: v for k, v in dev._programs.items() if k[0].split("/")[0] != wing}
    else:
        monkeypatch.setattr(device_module, "Program", flipping(file, text, flipped))
        others = {key: program for key, program in dev._programs.items() if key[0] != file}
    monkeypatch.setattr(dev, "_programs", others)
    assert [row.case for row in run_cases(dev, [case]) if not row.passed] == [name]


def acts_as_cpu(dev, file, text):
    """dev.is_cpu, except for a kernel that only CPUs or only GPUs run."""
    if file == "raster/lists_by_key":
        return False
    return (
        dev.is_cpu
        or file in ("raster/pairs", "raster/gradients.h")
        or file.startswith("layers/winograd")
    )


def flipping(file, text, flipped):
    """A factory of Programs that replaces `text` in the source of `file`, where it must stand once.

    The options stay those of the file, so that a driver finds in its cache what it has built
    before.
    """

    def made(dev, name, source, **more):
        if name == file:
            source = source.replace(text, flipped)
        return Program(dev, name, source, **more)

    return made


def test_every_kernel_file_is_flipped():
    files = {path.relative_to(KERNELS).with_suffix("").as_posix() for path in KERNELS.rglob("*.cl")}
    assert files == {file for file, *_ in FLIPS if not file.endswith(".h")}
