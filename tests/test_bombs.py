"""Small files that claim, or unfold to, more memory than there is: each is refused with one line
by a process that may take 1 GiB more than the program itself. Here are images and meshes, which
libraries read; the bounds of what pp-cl reads itself are tested where it is read.
"""

import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest

from pp_cl.files.exr import write_exr

pytestmark = [pytest.mark.slow, pytest.mark.unix]

READ = """
import resource
import sys
from pathlib import Path
import pp_cl.metrics.compare  # its memory is to be there before a bomb
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.metrics.shape import read_mesh

path = Path(sys.argv[1])
read = read_rgba if path.suffix in (".png", ".exr") else read_mesh
mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (mapped + 2**30, resource.RLIM_INFINITY))
try:
    sys.exit(read(path) is None)
except UserError as error:
    print(f"pp-cl: {error}", file=sys.stderr)
    sys.exit(2)
"""


def channels(path):
    """60 beside R, G, B and A, which are not unpacked."""
    zeros = np.zeros((2048, 2048), np.float16)
    more = {f"extra.{i:02d}": zeros for i in range(60)}
    write_exr(path, dict.fromkeys("RGBA", zeros) | more)


def chunk(kind, content):
    crc = struct.pack(">I", zlib.crc32(kind + content))
    return struct.pack(">I", len(content)) + kind + content + crc


def png(width, height, *chunks):
    header = chunk(b"IHDR", struct.pack(">2I5B", width, height, 8, 6, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + chunk(b"IEND", b"")


def unfolding_png():
    """Of 10x10 pixels, with pixels and a text of 256 MiB each."""
    zeros = zlib.compress(bytes(2**28), 1)
    return png(10, 10, chunk(b"zTXt", b"a\0\0" + zeros), chunk(b"IDAT", zeros))


PLY = (
    f"ply\nformat binary_little_endian 1.0\nelement vertex {10**9}\nproperty float x\n"
    f"property float y\nproperty float z\nelement face {10**9}\n"
    "property list uchar int vertex_indices\nend_header\n"
).encode() + bytes(1000)


# {file: what is written into it}
FILES = {
    "65535x65535.png": lambda file: file.write_bytes(png(65535, 65535)),
    "10x10 that unfolds.png": lambda file: file.write_bytes(unfolding_png()),
    "60 channels.exr": channels,
    "1e9 vertices.ply": lambda file: file.write_bytes(PLY),
}


@pytest.mark.parametrize("name", FILES)
def test_it_is_refused_within_a_gigabyte(tmp_path, name):
    FILES[name](tmp_path / name)
    command = [sys.executable, "-c", READ, str(tmp_path / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    if name == "60 channels.exr":
        assert done.returncode == 0
    else:
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert str(tmp_path) in done.stderr
