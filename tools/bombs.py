"""Small files that claim, or unfold to, more memory than there is: what each takes to be refused.

python -m tools.bombs            # one after the other, each in a process of its own
python -m tools.bombs --write    # and docs/results/bombs.json, then `make docs`
"""

import argparse
import gzip
import io
import json
import os
import resource
import struct
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import trimesh
from PIL import Image

import pp_cl.facts.info  # its memory is to be there before a bomb
import pp_cl.metrics.compare  # noqa: F401
from pp_cl import cli
from pp_cl.config import preset
from pp_cl.device.host import at_most_more, resident_bytes
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.metrics.shape import read_mesh
from pp_cl.scene.readers.camera_file import read_cameras

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "bombs.json"
MOST = 2**30  # bytes that a process may map beyond what it has before it reads
UNDER = 2**62  # a count that no memory holds

Action = Callable[[Path], int]


def _info(path):
    return cli.main(["info", str(path)])


def _of_parent(path):
    return _info(path.parent)


def _compare(path):
    return cli.main(["compare", str(path), str(path)])


def _direct(read):
    def action(path):
        try:
            read(path)
        except UserError as error:
            print(f"pp-cl: {error}", file=sys.stderr)
            return 2
        return 0

    return action


def _text(name, text):
    def make(folder):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text() if callable(text) else text)
        return path

    return make


def _sparse(name, size, start=b""):
    """A file with a beginning, and nothing up to its size."""

    def make(folder):
        path = _text(name, start)(folder)
        os.truncate(path, size)
        return path

    return make


# Scenes -------------------------------------------------------------------------------------------


def _annotations(text, times):
    """A sequence of CO3D whose annotations are "[" and a text, many times over."""

    def make(folder):
        (folder / "category/sequence/images").mkdir(parents=True)
        file = folder / "category/frame_annotations.jgz"
        file.write_bytes(gzip.compress(b"[") + gzip.compress(text * (2**24 // len(text))) * times)
        return folder / "category/sequence"

    return make


def _lists():
    return b'{"frames":[' + b"[]," * (20 * 2**20) + b"[]]}"


LONG_FRAME = b'{"sequence_name":"sequence","x":[' + b"[]," * 40_000 + b"1]},"
_nested = _text("transforms.json", b"[" * 10**6)
CAMERA = struct.pack("<IiQQ3d", 1, 0, 10, 10, 5.0, 5.0, 5.0)
IMAGE = struct.pack("<I7dI", 1, 1.0, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0"


def _colmap(cameras, images):
    def make(folder):
        model = folder / "scene/sparse/0"
        model.mkdir(parents=True)
        (model / "cameras.bin").write_bytes(cameras())
        (model / "images.bin").write_bytes(images())
        return folder / "scene"

    return make


def _many_cameras():
    entries = np.frombuffer(CAMERA * 140_000, np.uint8).reshape(-1, len(CAMERA)).copy()
    entries[:, :4] = np.arange(len(entries), dtype="<u4").view(np.uint8).reshape(-1, 4)
    return struct.pack("<Q", UNDER) + entries.tobytes()


def _one_camera():
    return struct.pack("<Q", 1) + CAMERA


def _many_images():
    return struct.pack("<Q", UNDER) + (IMAGE + struct.pack("<Q", 0)) * 140_000


def _long_track():
    return struct.pack("<Q", 1) + IMAGE + struct.pack("<Q", UNDER)


def _endless_line(folder):
    model = folder / "scene/sparse/0"
    _text("scene/sparse/0/cameras.txt", b"1 PINHOLE 10 10 5 5 5 5\n")(folder)
    _sparse("images.txt", 2**32, b"1 1 0 0 0 0 0 0 1 a.png\n")(model)
    return folder / "scene"


def _array(shape, version=(1, 0), pad=0):
    """The header of a .npy file."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * pad + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + length + text


def _packed(content):
    """A scene of NeuS with one deflated array."""

    def make(folder):
        path = folder / "scene/cameras_sphere.npz"
        path.parent.mkdir()
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("world_mat_0.npy", content())
        return path.parent

    return make


def _directory(path):
    """A zip of a million entries at one place."""
    entry = b"PK\1\2" + struct.pack("<6H3I5H2I", 20, 20, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0)
    data = (entry + b"a.npy") * 2**20
    data += b"PK\5\6" + struct.pack("<4H2IH", 0, 0, 0, 0, len(data), 0, 0)
    return _text("scene/cameras_sphere.npz", data)(path).parent


def _poses(folder):
    (folder / "images").mkdir()
    Image.new("RGB", (8, 8)).save(folder / "images/a.png")
    return _sparse("poses_bounds.npy", 2**36, _array((2**29, 17)))(folder)


# Images -------------------------------------------------------------------------------------------


def _channels(folder):
    zeros = np.zeros((2048, 2048), np.float16)
    channels = dict.fromkeys("RGBA", zeros) | {f"extra.{i:02d}": zeros for i in range(60)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(folder / "a.exr"))
    return folder / "a.exr"


def _window(folder):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    plane = np.zeros((8, 8), np.float32)
    OpenEXR.File(header, dict.fromkeys("RGB", plane)).write(str(folder / "a.exr"))
    data = (folder / "a.exr").read_bytes()
    box = struct.pack("<4i", 0, 0, 7, 7)
    (folder / "a.exr").write_bytes(data.replace(box, struct.pack("<4i", 0, 0, 99_999, 99_999)))
    return folder / "a.exr"


def _chunk(kind, content):
    return (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )


def _png(width, height, *chunks):
    header = _chunk(b"IHDR", struct.pack(">2I5B", width, height, 8, 6, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + _chunk(b"IEND", b"")


def _unfolding_png():
    """Of 10x10 pixels, with pixels and a text of 256 MiB each."""
    zeros = zlib.compress(bytes(2**28), 1)
    return _png(10, 10, _chunk(b"zTXt", b"a\0\0" + zeros), _chunk(b"IDAT", zeros))


def _jpeg():
    made = io.BytesIO()
    Image.new("RGB", (8, 8)).save(made, "JPEG")
    return made.getvalue().replace(struct.pack(">2H", 8, 8), b"\xff\xdc" * 2, 1)


def _webp():
    size = (16383 - 1).to_bytes(3, "little")
    return b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<II", 10, 0) + size * 2


# Meshes and runs ----------------------------------------------------------------------------------


def _ply():
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {10**9}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {10**9}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode() + bytes(1000)


def _glb():
    """A ball of 5,120 triangles that is there 20,000 times."""
    ball = trimesh.creation.icosphere(subdivisions=4).export(file_type="glb")
    size = struct.unpack_from("<I", ball, 12)[0]
    tree = json.loads(ball[20 : 20 + size])
    tree |= {"nodes": [{"mesh": 0}] * 20_000, "scenes": [{"nodes": list(range(20_000))}]}
    text = json.dumps(tree | {"scene": 0}).encode()
    text += b" " * (-len(text) % 4)
    rest = struct.pack("<2I", len(text), 0x4E4F534A) + text + ball[20 + size :]
    return struct.pack("<4s2I", b"glTF", 2, 12 + len(rest)) + rest


def _run(make):
    """A run of the demo with another file in its folder."""

    def with_config(folder):
        run = folder / "run"
        run.mkdir()
        config = preset("tiny")
        config.scene.path = "demo"
        (run / "config.json").write_text(config.to_json())
        make(run)
        return run

    return with_config


def _checkpoint(folder):
    with zipfile.ZipFile(folder / "checkpoint.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.npy", _array((2**25,)) + bytes(2**28))


# --------------------------------------------------------------------------------------------------

# {kind: (makes it in a folder and tells what to give, what is done with it, status)}
KINDS: dict[str, tuple[Callable[[Path], Path], Action, int]] = {
    "transforms.json, 20 million empty lists": (_text("transforms.json", _lists), _of_parent, 2),
    "transforms.json, sparse, 64 GiB": (_sparse("transforms.json", 2**36), _of_parent, 2),
    "transforms.json, a million lists in each other": (_nested, _of_parent, 2),
    "frame_annotations.jgz, empty objects": (_annotations(b"{},", 13), _info, 2),
    "frame_annotations.jgz, spaces": (_annotations(b" ", 128), _info, 2),
    "frame_annotations.jgz, a sequence of long frames": (_annotations(LONG_FRAME, 1), _info, 2),
    "cameras.bin, 4.6e18 cameras": (_colmap(_many_cameras, _long_track), _info, 2),
    "images.bin, 4.6e18 images": (_colmap(_one_camera, _many_images), _info, 2),
    "images.bin, 4.6e18 points of an image": (_colmap(_one_camera, _long_track), _info, 2),
    "images.txt, a line of 4 GiB": (_endless_line, _info, 2),
    "cameras_sphere.npz, 256 MiB of zeros": (
        _packed(lambda: _array((2**25,)) + bytes(2**28)),
        _info,
        2,
    ),
    "cameras_sphere.npz, an array's header of 256 MiB": (
        _packed(lambda: _array((4, 4), (2, 0), 2**28)),
        _info,
        2,
    ),
    "cameras_sphere.npz, a million entries": (_directory, _info, 2),
    "poses_bounds.npy, sparse, 64 GiB": (_poses, _of_parent, 2),
    "EXR, 60 channels beside R, G, B and A": (_channels, _direct(read_rgba), 0),
    "EXR, data window of 100000x100000": (_window, _compare, 2),
    "PNG, 65535x65535": (_text("a.png", _png(65535, 65535)), _compare, 2),
    "PNG, 10x10, that unfolds to 512 MiB": (_text("a.png", _unfolding_png), _compare, 2),
    "JPEG, 65500x65500": (_text("a.jpg", _jpeg), _compare, 2),
    "WebP, 16383x16383": (_text("a.webp", _webp), _compare, 2),
    "PLY, 1e9 vertices": (_text("a.ply", _ply), _direct(read_mesh), 2),
    "GLB, a ball 20,000 times": (_text("a.glb", _glb), _direct(read_mesh), 2),
    "OBJ, sparse, 64 GiB": (_sparse("a.obj", 2**36), _direct(read_mesh), 2),
    "path.json, 20 million empty lists": (_text("path.json", _lists), _direct(read_cameras), 2),
    "checkpoint.npz, 256 MiB of zeros": (_run(_checkpoint), _info, 2),
    "metrics.json, 20 million empty lists": (
        _run(_text("eval/metrics.json", _lists)),
        _info,
        2,
    ),
    "log.jsonl, sparse, 64 GiB": (_run(_sparse("log.jsonl", 2**36)), _info, 2),
}


def measure(kind: str, folder: Path) -> dict[str, Any]:
    """{"kind", "bytes" of the file, "status", "message", "mib" of memory at its peak beyond what
    was there before, "seconds"} of a bomb that is made in an empty folder and read by a process
    which may map MOST bytes more.
    """
    make, action, _ = KINDS[kind]
    path = make(folder)
    size = max(file.stat().st_blocks * 512 for file in folder.rglob("*") if file.is_file())
    told, start, before = folder / "told", time.monotonic(), resident_bytes()
    child = os.fork()
    if not child:
        _read(action, path, told)
    _, status, usage = os.wait4(child, 0)
    return {
        "kind": kind,
        "kib": size // 1024,
        "status": os.waitstatus_to_exitcode(status),
        "message": told.read_text().replace(f"{folder}/", "").strip(),
        "mib": max(0, usage.ru_maxrss * 1024 - before) // 2**20,
        "seconds": round(time.monotonic() - start, 1),
    }


def _read(action, path, told):
    """In a process of its own, which ends here with the status of a bomb."""
    status = 99
    try:
        output = os.open(told, os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with at_most_more(MOST):
            status = action(path)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def main() -> int:
    """Measure all kinds; the status is 1 where one was not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help=f"also write {RESULTS.name}")
    parser.add_argument("--only", default="", metavar="WORD", help="kinds with this in the name")
    given, rows = parser.parse_args(), []
    for kind in (name for name in KINDS if given.only in name):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(kind, Path(folder)))
        print(json.dumps(rows[-1]), flush=True)
    if given.write:
        RESULTS.write_text(json.dumps(_results(rows), indent=1) + "\n", "utf-8")
    return int(any(row["status"] != KINDS[row["kind"]][2] for row in rows))


def _results(rows):
    return {
        "measured": f"memory beyond that of the program, which could take {MOST >> 30} GiB more",
        "version": "0.1.0",
        "command": "python -m tools.bombs --write",
        "columns": [
            {"head": "file", "cell": "{kind}"},
            {"head": "KiB on the disk", "cell": "{kib:,}"},
            {"head": "peak MiB", "cell": "{mib:,}"},
            {"head": "answer", "cell": "{message}"},
        ],
        "rows": [{k: row[k] for k in ("kind", "kib", "mib", "message")} for row in rows],
    }


if __name__ == "__main__":
    sys.exit(main())
