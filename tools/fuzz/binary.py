"""Bytes out of joint: files cut, flipped and grown, archives, arrays and the chunks of PNG."""

import io
import struct
import zipfile
import zlib
from random import Random

import numpy as np

BOMB = 2**25  # bytes that a deflated member of an archive unfolds to
FIELDS = ("<I", "<i", "<Q", "<d", "<f", ">I", "<H")
ODD_WHOLE = (0, 1, 2, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1)
ODD_REAL = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e30, -1e30, 1e38, 1e300, float("nan"), float("inf"))
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def changed_bytes(rng: Random, data: bytes) -> tuple[str, bytes]:
    """(label, bytes) of a damage that knows no structure."""
    new, n = bytearray(data), max(1, len(data))
    kind = rng.choice(
        [
            "cut",
            "flip",
            "flip",
            "byte",
            "insert",
            "delete",
            "double",
            "zeros",
            "tail",
            "head",
            "field",
            "field",
        ]
    )
    at = rng.randrange(n)
    if kind == "cut":
        del new[at:]
    elif kind == "flip":
        for _ in range(rng.choice([1, 1, 2, 8, 64])) if data else ():
            new[rng.randrange(n)] ^= 1 << rng.randrange(8)
    elif kind == "byte":
        new[at : at + 1] = bytes([rng.choice([0, 255, 127, 128, 10, 34, rng.randrange(256)])])
    elif kind == "insert":
        new[at:at] = rng.randbytes(rng.choice([1, 4, 100]))
    elif kind == "delete":
        del new[at : at + rng.choice([1, 4, 100])]
    elif kind == "double":
        new[at:at] = new[at : at + rng.choice([16, 300])]
    elif kind == "zeros":
        length = min(rng.choice([1, 16, 512]), len(data) - at)
        new[at : at + length] = bytes(length)
    elif kind == "tail":
        new += rng.randbytes(rng.choice([1, 50]))
    elif kind == "head":
        new[0:0] = rng.choice([b"\0", b"\xef\xbb\xbf", b"PK\x03\x04", b"#!/bin/sh\n"])
    else:
        form, value = field(rng)
        new[at : at + struct.calcsize(form)] = struct.pack(form, value)
        kind = f"field {form} = {value}"
    return f"{kind} at {at}", bytes(new)


def field(rng: Random) -> tuple[str, int | float]:
    """(struct format, odd value of it)."""
    form = rng.choice(FIELDS)
    if form[1] in "df":
        value = rng.choice(ODD_REAL)
        return form, float("inf") if form == "<f" and abs(value) > 3e38 else value
    bits = 8 * struct.calcsize(form)
    value = rng.choice(ODD_WHOLE) % 2**bits
    return form, value - 2**bits if form == "<i" and value >= 2 ** (bits - 1) else value


# --------------------------------------------------------------------------------------------------


def npy(array: np.ndarray) -> bytes:
    """The array as a .npy file."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def changed_array(rng: Random, array: np.ndarray) -> tuple[str, np.ndarray]:
    """(label, another array): of another shape, dtype, order or with odd values."""
    kind = rng.choice(["value"] * 4 + ["dtype", "shape", "cut", "empty", "order", "object", "all"])
    array = np.array(array)
    if kind == "value" and array.size:
        value = rng.choice([*ODD_REAL, *map(float, ODD_WHOLE[:10])])
        with np.errstate(all="ignore"):
            array.reshape(-1)[rng.randrange(array.size)] = np.float64(value).astype(array.dtype)
        return f"{kind} {value}", array
    if kind == "dtype":
        code = rng.choice(
            ["f2", "f4", "f8", ">f8", "i4", "u1", "i8", "c8", "U3", "?", "M8[s]", "S4"]
        )
        with np.errstate(all="ignore"):
            return f"{kind} {code}", array.astype(code, casting="unsafe")
    if kind == "shape":
        shapes = [(-1,), (1, *array.shape), (*array.shape, 1), array.shape[::-1], ()]
        shape = rng.choice(shapes)
        return f"{kind} {shape}", array.reshape(shape) if shape else np.float64(1).reshape(())
    if kind == "cut":
        return kind, array[:-1] if array.ndim else array
    if kind == "empty":
        return kind, array[:0] if array.ndim else array
    if kind == "order":
        return kind, np.asfortranarray(array)
    if kind == "object":
        return kind, np.array([{"a": 1}, None], object)
    value = rng.choice(ODD_REAL)
    with np.errstate(all="ignore"):
        return f"{kind} {value}", np.full_like(array, np.float64(value).astype(array.dtype))


def changed_npy(rng: Random, data: bytes) -> tuple[str, bytes]:
    """(label, bytes) of a .npy file with another array, or another header."""
    kind = rng.choice(["array"] * 3 + ["header", "header", "bytes"])
    if kind == "array":
        label, array = changed_array(rng, np.load(io.BytesIO(data), allow_pickle=False))
        return label, npy(array)
    if kind == "bytes":
        return changed_bytes(rng, data)
    length = int.from_bytes(data[8:10], "little")
    old = data[10 : 10 + length].decode("latin-1")
    header = rng.choice(
        [
            old.replace("(", "(99999999, "),
            old.replace("(", "(-1, "),
            old.replace("<f", "<c"),
            old.replace("False", "True"),
            "(" * 900,
            "{}",
            "__import__('os').getcwd()",
            old[:-9],
            old.replace("'shape'", "'shapes'"),
            old.replace("(", "(2305843009213693952, 8, "),
            old.replace("(", "(True, "),
            old.replace("(", f"({'9' * 5000}, "),
            "[" * 5000 + "]" * 5000,
        ]
    )[:60_000]
    label = f"header {header[:60]!r}"
    return label, data[:8] + len(header).to_bytes(2, "little") + header.encode("latin-1") + data[
        10 + length :
    ]


def changed_npz(rng: Random, data: bytes) -> tuple[str, bytes]:
    """(label, bytes) of an archive of arrays with a changed, missing, doubled or strange member."""
    if rng.random() < 0.2:
        return changed_bytes(rng, data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    at = rng.randrange(len(members))
    name, content = members[at]
    kind = rng.choice(
        ["member"] * 8 + ["gone", "renamed", "twice", "stranger", "bomb", "deflated", "swapped"]
    )
    form = zipfile.ZIP_STORED
    if kind == "member":
        kind, members[at] = _of_member(rng, name, content)
    elif kind == "gone":
        del members[at]
    elif kind == "renamed":
        members[at] = (
            rng.choice(["x.npy", "../x.npy", name.upper(), "x" * 300, name[:-4], ""]),
            content,
        )
    elif kind == "twice":
        members.append((name, content))
    elif kind == "stranger":
        members.append((rng.choice(["readme.txt", "a\nb.npy", "x.npy", "/x.npy"]), content))
    elif kind == "bomb":
        members[at], form = (name, content + bytes(BOMB)), zipfile.ZIP_DEFLATED
    elif kind == "deflated":
        form = rng.choice([zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
    else:
        other = rng.randrange(len(members))
        members[at], members[other] = (name, members[other][1]), (members[other][0], content)
    return f"{name}: {kind}", archived(members, form)


def _of_member(rng, name, content):
    label, changed = changed_npy(rng, content)
    return label, (name, changed)


def archived(members: list[tuple[str, bytes]], form: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of the members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", form) as archive:
        for name, content in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = form
            archive.writestr(info, content)
    return file.getvalue()


# --------------------------------------------------------------------------------------------------


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """[(kind, content)] of a PNG."""
    found, at = [], len(PNG_SIGNATURE)
    while at + 8 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        found.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def png(parts: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG of these chunks, their checksums right."""
    return PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in parts
    )


def changed_png(rng: Random, data: bytes) -> tuple[str, bytes]:
    """(label, bytes) of a PNG whose chunks are changed under right checksums."""
    parts = chunks(data)
    at = rng.randrange(len(parts))
    kind, content = parts[at]
    how = rng.choice(["size", "size", "header", "content", "gone", "twice", "strange", "bomb"])
    if how in ("size", "header"):
        head = bytearray(parts[0][1])
        if how == "size":
            place = rng.choice([0, 4])
            head[place : place + 4] = struct.pack(
                ">I", rng.choice([0, 1, 13, 9000, 30_000, 2**31 - 1, 2**32 - 1])
            )
        else:
            head[rng.randrange(8, 13)] = rng.randrange(20)
        parts[0] = b"IHDR", bytes(head)
    elif how == "content":
        label, content = changed_bytes(rng, content)
        parts[at], how = (kind, content), f"{kind} {label}"
    elif how == "gone":
        del parts[at]
    elif how == "twice":
        parts.insert(at, parts[at])
    elif how == "strange":
        name = rng.choice(
            [
                b"tRNS",
                b"PLTE",
                b"acTL",
                b"fcTL",
                b"fdAT",
                b"eXIf",
                b"iCCP",
                b"zTXt",
                b"tEXt",
                b"gAMA",
                b"abcd",
            ]
        )
        parts.insert(
            rng.randrange(1, len(parts)), (name, rng.randbytes(rng.choice([0, 1, 4, 26, 300])))
        )
    else:
        text = b"a\0\0" + zlib.compress(bytes(BOMB))
        parts.insert(1, (rng.choice([b"zTXt", b"iCCP"]), text))
    return f"png {how}", png(parts)
