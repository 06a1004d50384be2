"""Damage to files, drawn by Hypothesis: JSON, lines of text, bytes, archives of arrays, images.

`draw` is that of st.data(): each choice is printed with an example that fails, and shrinks.
"""

import copy
import gzip
import io
import json
import math
import os
import struct
import warnings
import zipfile
import zlib

import numpy as np
from hypothesis import strategies as st

BOMB = bytes(2**25)  # what a few deflated bytes unfold to
NUMBERS = [0, -1, 1, 2, 3, 0.5, -0.0, 1e-7, 1e-45, 5e-324, 1e5, 1e9, 1e20, 1e38, 3.5e38, -1e300]
NUMBERS += [2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63, 10**25]
TEXTS = ["", " ", "x", "nan", "-inf", "1e400", "0x10", "1_000", "٣", "1.5", "true", "1,2,3"]
TEXTS += ["../..", "/etc/passwd", "~", "a/b", "a\nb", "a\x1b[31mb", "a\0b", "a\u2028b", "ä", "😀"]
TEXTS += ["%s", "{0}", "$HOME", "'", '"', "x" * 300, "x" * 100_000, "9" * 5000, "[" * 5000]
# what JSON holds beside numbers and texts
VALUES = [math.nan, math.inf, -math.inf, 10**400, {}, [], [[]], None, [None], True, [["a"]]]
VALUES += ["\ud800", "\udcff", json.loads("[" * 200 + "]" * 200)]
# that files of JSON may have beside the keys of a template
NAMES = (
    "format fl_x cx w near far camera_angle_x k1 k4 p2 camera_model mask_path file_path frames fov"
    " test_filenames applied_transform aabb_scale path size intrinsics_format mass R focal_length"
    " frame_number camera_path camera_to_world render_width rotation position width fx scene train"
    " points preset grid step finished seconds psnr loss device mean ms rel_l2 rows kind"
)
KEYS = [*NAMES.split(), "", "__class__", "a\nb", "x" * 5000, "ä"]
DTYPES = ["f2", "f4", "f8", ">f8", "i4", "u1", "i8", "c8", "U3", "?", "M8[s]", "S4"]
SHAPES = ["99999999, ", "-1, ", "2305843009213693952, 8, ", "True, ", "9" * 5000 + ", "]
CHUNKS = [b"tRNS", b"PLTE", b"acTL", b"fcTL", b"fdAT", b"eXIf", b"iCCP", b"zTXt", b"gAMA"]

numbers = st.sampled_from(NUMBERS) | st.floats() | st.integers()
texts = st.sampled_from(TEXTS) | st.text(max_size=8)
# copies: what is put into a damaged value may be damaged in its turn
odd_values = st.one_of(numbers, st.sampled_from(VALUES).map(copy.deepcopy), texts)
words = st.one_of(
    st.sampled_from(TEXTS),
    st.lists(numbers.map(repr), min_size=1, max_size=6).map(",".join),
    st.text(max_size=12),
)


def one(draw, *choices):
    """One of a few; the first is the simplest."""
    return draw(st.sampled_from(choices))


def rarely(draw, times=10):
    """Whether to do what takes long, one in so many times."""
    return draw(st.integers(1, times)) == times


def place_in(draw, sized):
    """An index of something that is not empty."""
    return draw(st.integers(0, len(sized) - 1))


def places(value):
    """[(dict or list, key)] of all values inside a value of JSON."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value)
    found = [(value, key, part) for key, part in pairs]
    nested = [
        place for *_, part in found if isinstance(part, dict | list) for place in places(part)
    ]
    return [(owner, key) for owner, key, _ in found] + nested


def damaged_json(draw, value):
    """The bytes of a value of JSON with one to three changes."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        found = places(value)
        if not found:
            break
        owner, key = found[place_in(draw, found)]
        old, kind = owner[key], one(draw, *["odd"] * 5, "drop", "add", "add", "wrap", "scale")
        target = old if isinstance(old, dict | list) else owner
        if kind == "drop":
            del owner[key]
        elif kind == "add" and isinstance(target, dict):
            target[one(draw, *KEYS)] = draw(odd_values)
        elif kind == "add":
            target.insert(
                draw(st.integers(0, len(target))), draw(odd_values | st.just(copy.deepcopy(old)))
            )
        elif kind == "wrap":
            owner[key] = one(draw, [old], {"a": old}, [old, old], str(old)[:200], [[old]])
        elif kind == "scale" and type(old) in (int, float):
            owner[key] = old * one(draw, -1, 0, 2, 1e-9, 1e9, 1 + 1e-6, 1e30)
        else:
            owner[key] = draw(odd_values)
    return json.dumps(value).encode()


def damaged_text(draw, data):
    """The bytes of a text with another word or line, or in another coding."""
    text = data.decode("utf-8", "replace")
    lines = text.split("\n")
    at, kind = place_in(draw, lines), one(draw, *["word"] * 8, "line", "drop", "double", "coding")
    if kind == "word":
        parts = lines[at].split(" ")
        parts[place_in(draw, parts)] = draw(words)
        lines[at] = " ".join(parts)
    elif kind == "coding":
        code = one(draw, "utf-8-sig", "utf-16", "utf-32", "utf-16-le", "utf-7", "cp037")
        return one(draw, text.encode(code, "replace"), data * 2, b" " * 10**6 + data)
    else:
        lines[at : at + 1] = {"line": [draw(words)], "drop": [], "double": lines[at : at + 1] * 2}[
            kind
        ]
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def damaged_bytes(draw, data):
    """Bytes with a damage that knows no structure."""
    new = bytearray(data or b"\0")
    at, count = place_in(draw, new), one(draw, 1, 4, 100, len(new))
    kind = one(draw, "flip", "flip", "field", "delete", "zeros", "double", "replace", "head")
    if kind == "flip":
        for _ in range(one(draw, 1, 1, 2, 8)):
            new[place_in(draw, new)] ^= 1 << draw(st.integers(0, 7))
    elif kind == "field":
        number = one(draw, *(n for b in (0, 8, 15, 16, 31, 32, 40, 63) for n in (2**b - 1, 2**b)))
        packed = [number.to_bytes(8, "little")[:n] for n in (2, 4, 8)]
        packed += [struct.pack(form, draw(st.floats(width=32))) for form in ("<f", "<d")]
        field = one(draw, *packed, number.to_bytes(8, "big")[4:])
        new[at : at + len(field)] = field
    elif kind == "head":
        new[0:0] = one(draw, b"\0", b"\xef\xbb\xbf", b"PK\x03\x04", b"#!/bin/sh\n")
    else:
        old = new[at : at + count]
        drawn = draw(st.binary(max_size=100)) if kind == "replace" else b""
        new[at : at + count] = {"zeros": bytes(len(old)), "double": old * 2}.get(kind, drawn)
    return bytes(new)


# --------------------------------------------------------------------------------------------------


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


def damaged_array(draw, array):
    """An array with odd values, or of another dtype, shape or order."""
    kind = one(draw, *["value"] * 4, "all", "dtype", "shape", "order", "object")
    with np.errstate(all="ignore"):
        if kind in ("value", "all") and array.size:
            array, value = array.copy(), np.float64(draw(numbers)).astype(array.dtype)
            array.reshape(-1)[place_in(draw, array.reshape(-1)) if kind == "value" else ...] = value
        elif kind == "dtype":
            array = array.astype(one(draw, *DTYPES), casting="unsafe")
        elif kind == "shape":
            shapes = [(-1,), (1, *array.shape), (*array.shape, 1), array.shape[::-1]]
            array = [*(array.reshape(shape) for shape in shapes), array[:-1], array[:0], array[0]][
                draw(st.integers(0, 6))
            ]
        elif kind == "order":
            array = np.asfortranarray(array)
        elif kind == "object":
            array = np.array([{"a": 1}, None], object)
    return array


def damaged_npy(draw, data):
    """The bytes of a .npy file with another array or another header."""
    kind = one(draw, "array", "array", "array", "header", "header", "bytes")
    if kind == "array":
        return npy(damaged_array(draw, np.load(io.BytesIO(data), allow_pickle=False)))
    if kind == "bytes":
        return damaged_bytes(draw, data)
    end = 10 + int.from_bytes(data[8:10], "little")
    old = data[10:end].decode("latin-1")
    headers = [old.replace("(", f"({shape}") for shape in SHAPES]
    headers += [
        old.replace("<f", "<c"),
        old.replace("False", "True"),
        old.replace("'shape'", "'x'"),
    ]
    headers += ["(" * 900, "{}", "__import__('os').getcwd()", old[:-9], "[" * 5000 + "]" * 5000]
    header = headers[place_in(draw, headers)].encode("latin-1")
    return data[:8] + len(header).to_bytes(2, "little") + header + data[end:]


def damaged_npz(draw, data):
    """The bytes of an archive of arrays with a changed, missing, doubled or strange member."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(zip_info.filename, archive.read(zip_info)) for zip_info in archive.infolist()]
    at, other = place_in(draw, members), place_in(draw, members)
    name, content = members[at]
    kind = one(draw, *["member"] * 7, "drop", "name", "double", "stranger", "bomb", "form", "swap")
    form = one(draw, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    if kind == "member":
        members[at] = (name, damaged_npy(draw, content))
    elif kind == "drop":
        del members[at]
    elif kind == "name":
        members[at] = (one(draw, "x.npy", "../x.npy", name.upper(), "x" * 300, ""), content)
    elif kind == "double":
        members.append((name, content))
    elif kind == "stranger":
        members.append((one(draw, "readme.txt", "a\nb.npy", "x.npy", "/x.npy"), content))
    elif kind == "bomb":
        members[at] = (name, content + BOMB)
    elif kind == "swap":
        members[at], members[other] = (name, members[other][1]), (members[other][0], content)
    return archived(members, form if kind in ("bomb", "form") else zipfile.ZIP_STORED)


def damaged_png(draw, data):
    """The bytes of a PNG whose chunks are changed under right checksums."""
    parts, at = [], 8
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        parts.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    at, head = place_in(draw, parts), bytearray(parts[0][1])
    how = one(draw, "size", "header", "content", "drop", "double", "strange", "bomb")
    if how == "size":
        side = one(draw, 0, 1, 13, 9000, 30_000, 2**31 - 1, 2**32 - 1)
        struct.pack_into(">I", head, one(draw, 0, 4), side)
        parts[0] = b"IHDR", bytes(head)
    elif how == "header":
        head[draw(st.integers(8, 12))] = draw(st.integers(0, 19))
        parts[0] = b"IHDR", bytes(head)
    elif how == "content":
        parts[at] = parts[at][0], damaged_bytes(draw, parts[at][1])
    elif how == "strange":
        parts.insert(1, (one(draw, *CHUNKS), draw(st.binary(max_size=60))))
    elif how == "bomb":
        parts.insert(1, (one(draw, b"zTXt", b"iCCP"), b"a\0\0" + zlib.compress(BOMB)))
    else:
        parts[at : at + 1] = parts[at : at + 1] * (2 if how == "double" else 0)
    sums = (struct.pack(">I", zlib.crc32(kind + content)) for kind, content in parts)
    lengths = (struct.pack(">I", len(content)) for _, content in parts)
    chunks = zip(lengths, *zip(*parts, strict=True), sums, strict=True) if parts else ()
    return data[:8] + b"".join(map(b"".join, chunks))


# --------------------------------------------------------------------------------------------------


def damaged_lines(draw, data):
    """The bytes of lines of JSON with one changed."""
    lines = data.splitlines()
    at = place_in(draw, lines)
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
    """Change a file by its kind; now and then something else stands in its place."""
    data = file.read_bytes()
    kind = one(draw, *["kind"] * 6, "text", "text", "bytes", "displace")
    if kind == "displace":
        return displace(draw, file)
    if kind == "text" and b"\0" not in data:
        data = damaged_text(draw, data)
    else:
        known = kind == "kind" and BY_KIND.get(file.suffix)
        data = (known or damaged_bytes)(draw, data)
    file.unlink()  # it may be a link
    file.write_bytes(data)


def displace(draw, file):
    """Put something else in the place of a file."""
    kind = one(draw, "gone", "empty", "folder", "dangling", "loop", "pipe", "renamed", "outside")
    if kind == "renamed":
        file.rename(file.with_name(one(draw, "x", "ä", "x.png", f"{file.stem}.PNG", ".hidden")))
        return
    file.unlink()
    if kind == "empty":
        file.touch()
    elif kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind != "gone":
        file.symlink_to({"dangling": "nothing", "loop": file.name, "outside": "/etc/passwd"}[kind])
