"""Damage to files, drawn by Hypothesis: JSON, lines of text, bytes, archives of arrays, images.

`draw` is that of st.data(): choices are printed with a failing example, and shrink.
"""

import copy
import gzip
import io
import json
import os
import struct
import warnings
import zipfile
import zlib

import numpy as np
from hypothesis import strategies as st

BOMB = bytes(2**25)  # compresses to a few bytes
LIMITS = [0.5, 1e-7, 1e-45, 5e-324, 1e9, 1e38, 3.5e38, -1e300]
LIMITS += [n for bits in (8, 15, 16, 31, 32, 53, 63) for n in (2**bits - 1, 2**bits)] + [10**25]
TEXTS = ["", " ", "nan", "-inf", "1e400", "0x10", "1_000", "٣", "1,2,3", "../..", "/etc/passwd"]
TEXTS += ["a\nb", "a\x1b[31mb", "a\0b", "a\u2028b", "😀", "%s", "{0}", "$HOME", "'", '"']
TEXTS += ["x" * 300, "x" * 100_000, "9" * 5000, "[" * 5000]
# keys that JSON files may have, of all formats
NAMES = (
    "format fl_x cx w near far camera_angle_x k1 k4 p2 camera_model mask_path file_path frames fov"
    " test_filenames applied_transform aabb_scale path size intrinsics_format mass R focal_length"
    " frame_number camera_path camera_to_world render_width rotation position width fx scene train"
    " points preset grid step finished seconds psnr loss device mean ms rel_l2 rows kind"
)
DEEP = json.loads("[" * 200 + "]" * 200)
HEADERS = ["(" * 900, "{}", "__import__('os').getcwd()", "[" * 5000 + "]" * 5000]
SHAPES = ["99999999, ", "-1, ", "2305843009213693952, 8, ", "True, ", "9" * 5000 + ", "]
DTYPES = ["f2", "f8", ">f8", "i4", "u1", "c8", "U3", "?", "M8[s]", "O"]
CHUNKS = [b"tRNS", b"PLTE", b"acTL", b"fcTL", b"fdAT", b"eXIf", b"gAMA"]

numbers = st.sampled_from(LIMITS) | st.floats() | st.integers()
texts = st.sampled_from(TEXTS) | st.text(max_size=12)
keys = st.sampled_from(NAMES.split()) | texts
# copied, as a value that is put into another one may be damaged in its turn
values = st.recursive(
    st.none() | st.booleans() | numbers | texts | st.sampled_from([10**400, "\ud800", DEEP]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=4,
).map(copy.deepcopy)
words = texts | st.lists(numbers.map(repr), min_size=1, max_size=6).map(",".join)


def one(draw, *choices):
    """Draw one of a few choices, of which the first is the simplest."""
    return draw(st.sampled_from(choices))


def rarely(draw, times=10):
    """True once in `times` draws; for slow choices."""
    return draw(st.integers(1, times)) == times


def damaged_json(draw, value):
    """The bytes of JSON in which one value is changed, added or removed."""
    root = owner = {"": copy.deepcopy(value)}
    key = ""
    while owner[key] and isinstance(owner[key], dict | list) and not rarely(draw, 5):
        owner = owner[key]
        key = one(draw, *(owner if isinstance(owner, dict) else range(len(owner))))
    old, how = owner[key], one(draw, "odd", "odd", "odd", "scale", "add", "drop")
    if how == "scale" and type(old) in (int, float):
        owner[key] = old * one(draw, -1, 0, 1e-9, 1e9, 1 + 1e-6, 1e30)
    elif how == "add" and isinstance(old, dict):
        old[draw(keys)] = draw(values)
    elif how == "add" and isinstance(old, list):
        old.append(draw(values))
    elif how == "drop" and owner is not root:
        del owner[key]
    else:
        owner[key] = draw(values | st.just([old]))
    return json.dumps(root[""]).encode()


def damaged_text(draw, data):
    """The bytes of a text with one word replaced, or in another encoding."""
    text = data.decode("utf-8", "replace")
    if rarely(draw, 6):
        code = one(draw, "utf-8-sig", "utf-16", "utf-32", "utf-16-le", "cp037")
        return text.encode(code, "replace")
    parts = text.split(one(draw, " ", "\n"))
    parts[draw(st.integers(0, len(parts) - 1))] = draw(words)
    return " ".join(parts).encode("utf-8", "surrogatepass")


def damaged_bytes(draw, data):
    """The bytes with some of them removed, replaced or repeated."""
    at, gone = draw(st.integers(0, len(data))), one(draw, 1, 4, 0, 100, len(data))
    number = one(draw, *(n for n in LIMITS if isinstance(n, int) and n < 2**64))
    field = number.to_bytes(8, one(draw, "little", "big"))[: one(draw, 2, 4, 8)]
    real = struct.pack(one(draw, "<f", "<d"), draw(st.floats(width=32)))
    new = one(draw, draw(st.binary(max_size=9)), field, real, bytes(gone), data[at:] * 2)
    return data[:at] + new + data[at + gone :]


def npy(array):
    """The array as a .npy file."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def archived(members, form=zipfile.ZIP_STORED):
    """A zip archive of [(name, bytes)]."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", form) as archive, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Duplicate name")
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=form)
    return file.getvalue()


def damaged_npy(draw, data):
    """The bytes of a .npy file with another value, shape, type or header."""
    array = np.load(io.BytesIO(data), allow_pickle=False)
    kind = one(draw, "value", "value", "shape", "type", "header", "bytes")
    with np.errstate(all="ignore"):
        if kind == "value" and array.size:
            at = one(draw, draw(st.integers(0, array.size - 1)), ...)
            array.reshape(-1)[at] = np.float64(draw(numbers)).astype(array.dtype)
        elif kind == "shape":
            array = one(draw, array[None], array.T, array.reshape(-1), array[:0], array[:-1])
        elif kind == "type":
            array = array.astype(one(draw, *DTYPES), casting="unsafe")
    if kind == "bytes":
        return damaged_bytes(draw, data)
    if kind != "header":
        return npy(array)
    end = 10 + int.from_bytes(data[8:10], "little")
    old = data[10:end].decode("latin-1")
    changed = [old.replace("(", f"({shape}") for shape in SHAPES] + [old.replace("<f", "<c")]
    changed += [old.replace("False", "True"), old.replace("'shape'", "'x'"), old[:-9]]
    header = one(draw, *changed, *HEADERS).encode("latin-1")
    return data[:8] + len(header).to_bytes(2, "little") + header + data[end:]


def damaged_npz(draw, data):
    """The bytes of an .npz file with a member changed, missing, doubled or unknown."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    at, form = draw(st.integers(0, len(members) - 1)), zipfile.ZIP_STORED
    name, content = members[at]
    kind = one(draw, *["array"] * 6, "drop", "name", "twice", "stranger", "bomb", "swap")
    if kind == "array":
        members[at] = (name, damaged_npy(draw, content))
    elif kind == "drop":
        del members[at]
    elif kind == "name":
        members[at] = (one(draw, "x.npy", "../x.npy", name.upper(), "x" * 300, ""), content)
    elif kind == "swap":
        members[at] = (name, members[0][1])
    elif kind == "bomb":
        form = one(draw, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
        members[at] = (name, content + BOMB)
    else:
        members.append((name if kind == "twice" else one(draw, "a.txt", "a\nb.npy"), content))
    return archived(members, form)


def damaged_png(draw, data):
    """The bytes of a PNG with changed chunks and correct checksums."""
    parts, place = [], 8
    while place < len(data):
        end = place + 8 + int.from_bytes(data[place : place + 4], "big")
        parts.append((data[place + 4 : place + 8], data[place + 8 : end]))
        place = end + 4
    at = one(draw, 0, *range(len(parts)))
    strange = one(draw, *CHUNKS), draw(st.binary(max_size=60))
    bomb = one(draw, b"zTXt", b"iCCP"), b"a\0\0" + zlib.compress(BOMB)
    changed = parts[at][0], damaged_bytes(draw, parts[at][1])
    new = [[changed], [changed], [], [parts[at]] * 2, [parts[at], strange], [parts[at], bomb]]
    parts[at : at + 1] = one(draw, *new)
    chunks = [
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in parts
    ]
    return data[:8] + b"".join(chunks)


def damaged_lines(draw, data):
    """The bytes of JSON lines of which one is damaged."""
    lines = data.splitlines()
    at = draw(st.integers(0, len(lines) - 1))
    lines[at] = damaged_json(draw, json.loads(lines[at]))
    return b"\n".join(lines) + b"\n"


BY_KIND = {
    ".json": lambda draw, data: damaged_json(draw, json.loads(data)),
    ".jgz": lambda draw, data: gzip.compress(
        damaged_json(draw, json.loads(gzip.decompress(data))), 1
    ),
    ".jsonl": damaged_lines,
    ".npy": damaged_npy,
    ".npz": damaged_npz,
    ".png": damaged_png,
}


def damage_file(draw, file):
    """Damage a file according to its kind; sometimes put something else in its place."""
    data = file.read_bytes()
    kind = one(draw, *["kind"] * 6, "text", "text", "bytes", "displace")
    file.unlink()  # may be a link, whose target must not be written
    if kind == "displace":
        displace(draw, file)
    elif kind == "text" and b"\0" not in data:
        file.write_bytes(damaged_text(draw, data))
    else:
        known = kind == "kind" and BY_KIND.get(file.suffix)
        file.write_bytes((known or damaged_bytes)(draw, data))


def displace(draw, file):
    """Put a link, folder, pipe or empty file in the place of a file, or nothing."""
    kind = one(draw, "gone", "empty", "folder", "pipe", "nothing", file.name, "/etc/passwd")
    if kind == "empty":
        file.touch()
    elif kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind != "gone":
        file.symlink_to(kind)
