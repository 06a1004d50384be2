"""Small files that claim, or unfold to, more memory than there is: each is refused with one line
by a process that may take 1 GiB more than the program itself. One kind for each bound of a reader;
readers' own tests have what needs no such process.
"""

import gzip
import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

from pp_cl.config import preset

pytestmark = pytest.mark.slow

UNDER = 2**62  # a count that no memory holds
READ = """
import sys
from pathlib import Path
import pp_cl.commands.info_facts, pp_cl.metrics.compare  # their memory is to be there before a bomb
from pp_cl import cli
from pp_cl.device.host import at_most_more
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.metrics.shape import read_mesh

how, path = sys.argv[1:]
read = {"image": read_rgba, "mesh": read_mesh}.get(how)
with at_most_more(2**30):
    try:
        sys.exit(read(Path(path)) is None if read else cli.main([how, path]))
    except UserError as error:
        print(f"pp-cl: {error}", file=sys.stderr)
        sys.exit(2)
"""


def written(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def sparse(path, start=b""):
    """A file with a beginning, and nothing up to 64 GiB."""
    os.truncate(written(path, start), 2**36)
    return path


def lists():
    return b'{"frames":[' + b"[]," * (20 * 2**20) + b"[]]}"


def annotations(folder, text, times):
    """A sequence of CO3D whose annotations are "[" and a text, many times over."""
    packed = gzip.compress(b"[") + gzip.compress(text * (2**24 // len(text))) * times
    written(folder / "category/frame_annotations.jgz", packed)
    (folder / "category/sequence/images").mkdir(parents=True)
    return folder / "category/sequence"


CAMERA = struct.pack("<IiQQ3d", 1, 0, 10, 10, 5.0, 5.0, 5.0)
ONE_CAMERA = struct.pack("<Q", 1) + CAMERA
IMAGE = struct.pack("<I7dI", 1, 1.0, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0"


def colmap(folder, images, cameras=ONE_CAMERA):
    written(folder / "sparse/0/cameras.bin", cameras)
    written(folder / "sparse/0/images.bin", images)
    return folder


def many_cameras():
    entries = np.frombuffer(CAMERA * 140_000, np.uint8).reshape(-1, len(CAMERA)).copy()
    entries[:, :4] = np.arange(len(entries), dtype="<u4").view(np.uint8).reshape(-1, 4)
    return struct.pack("<Q", UNDER) + entries.tobytes()


def endless_line(folder):
    written(folder / "sparse/0/cameras.txt", b"1 PINHOLE 10 10 5 5 5 5\n")
    sparse(folder / "sparse/0/images.txt", b"1 1 0 0 0 0 0 0 1 a.png\n")
    return folder


def array(shape, version=(1, 0), pad=0):
    """The header of a .npy file."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * pad + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + length + text


def packed(path, member, content):
    """A zip with one deflated member, in a folder."""
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(member, content)
    return path.parent


def directory(folder):
    """A zip of a million entries at one place."""
    entry = b"PK\1\2" + struct.pack("<6H3I5H2I", 20, 20, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0)
    data = (entry + b"a.npy") * 2**20
    data += b"PK\5\6" + struct.pack("<4H2IH", 0, 0, 0, 0, len(data), 0, 0)
    return written(folder / "cameras_sphere.npz", data).parent


def poses(folder):
    (folder / "images").mkdir()
    Image.new("RGB", (8, 8)).save(folder / "images/a.png")
    return sparse(folder / "poses_bounds.npy", array((2**29, 17))).parent


def exr(path, channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    return path


def channels(folder):
    """60 beside R, G, B and A, which are not unpacked."""
    zeros = np.zeros((2048, 2048), np.float16)
    more = {f"extra.{i:02d}": zeros for i in range(60)}
    return exr(folder / "a.exr", dict.fromkeys("RGBA", zeros) | more)


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


def glb():
    """A ball of 5,120 triangles that is there 20,000 times."""
    ball = trimesh.creation.icosphere(subdivisions=4).export(file_type="glb")
    size = struct.unpack_from("<I", ball, 12)[0]
    tree = json.loads(ball[20 : 20 + size])
    tree |= {"nodes": [{"mesh": 0}] * 20_000, "scenes": [{"nodes": list(range(20_000))}]}
    text = json.dumps(tree | {"scene": 0}).encode()
    text += b" " * (-len(text) % 4)
    rest = struct.pack("<2I", len(text), 0x4E4F534A) + text + ball[20 + size :]
    return struct.pack("<4s2I", b"glTF", 2, 12 + len(rest)) + rest


def run_folder(folder):
    config = preset("tiny")
    config.scene.path = "demo"
    return written(folder / "config.json", config.to_json().encode()).parent


LONG = b'{"sequence_name":"sequence","x":[' + b"[]," * 40_000 + b"1]},"
ZEROS = array((2**25,)) + bytes(2**28)
# {kind: (how it is read, makes it in a folder and tells what to give)}
KINDS = {
    "transforms.json, 20 million lists": (
        "info",
        lambda f: written(f / "transforms.json", lists()).parent,
    ),
    "transforms.json, sparse": ("info", lambda f: sparse(f / "transforms.json").parent),
    "annotations, empty objects": ("info", lambda f: annotations(f, b"{},", 13)),
    "annotations, a sequence of long frames": ("info", lambda f: annotations(f, LONG, 1)),
    "cameras.bin, 4.6e18 cameras": ("info", lambda f: colmap(f, b"", many_cameras())),
    "images.bin, 4.6e18 images": (
        "info",
        lambda f: colmap(f, struct.pack("<Q", UNDER) + (IMAGE + struct.pack("<Q", 0)) * 140_000),
    ),
    "images.txt, an endless line": ("info", endless_line),
    "cameras.npz, zeros": (
        "info",
        lambda f: packed(f / "cameras.npz", "world_mat_0.npy", ZEROS),
    ),
    "cameras.npz, a long header": (
        "info",
        lambda f: packed(f / "cameras.npz", "world_mat_0.npy", array((4, 4), (2, 0), 2**28)),
    ),
    "cameras.npz, a million entries": ("info", directory),
    "poses_bounds.npy, sparse": ("info", poses),
    "EXR, 60 channels": ("image", channels),
    "PNG, 65535x65535": ("image", lambda f: written(f / "a.png", png(65535, 65535))),
    "PNG, 10x10 that unfolds": ("image", lambda f: written(f / "a.png", unfolding_png())),
    "PLY, 1e9 vertices": ("mesh", lambda f: written(f / "a.ply", PLY)),
    "GLB, a ball 20,000 times": ("mesh", lambda f: written(f / "a.glb", glb())),
    "OBJ, sparse": ("mesh", lambda f: sparse(f / "a.obj")),
    "log.jsonl, sparse": ("info", lambda f: sparse(run_folder(f) / "log.jsonl").parent),
}


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_refused_within_a_gigabyte(tmp_path, kind):
    how, make = KINDS[kind]
    command = [sys.executable, "-c", READ, how, str(make(tmp_path))]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    if kind == "EXR, 60 channels":
        assert done.returncode == 0
    else:
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert str(tmp_path) in done.stderr
