"""A colour profile with the primaries of Display P3, as phones write it, and a gamma of 2.2."""

import struct

import numpy as np

# columns: red, green and blue in XYZ, adapted to D50 (ICC)
P3 = np.array([[0.5151, 0.2920, 0.1571], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]])
SRGB = np.array([[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]])
GAMMA = 2.2


def display_p3(name=b"Display P3", primaries=P3, gamma=GAMMA):
    """The bytes of the profile, version 2, or of another one."""

    def xyz(values):
        return b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(v * 65536)) for v in values)

    curve = b"curv\0\0\0\0" + struct.pack(">IHxx", 1, round(gamma * 256))
    name += b"\0"
    described = b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78)
    tags = {b"desc": described, b"wtpt": xyz((0.9642, 1, 0.8249))}
    tags |= {b"%cXYZ" % c: xyz(primaries[:, i]) for i, c in enumerate(b"rgb")}
    tags |= {b"%cTRC" % c: curve for c in b"rgb"}
    table, data = b"", b""
    for key, content in tags.items():
        content += bytes(-len(content) % 4)
        table += key + struct.pack(">II", 132 + 12 * len(tags) + len(data), len(content))
        data += content
    size = 132 + len(table) + len(data)
    head = struct.pack(">I4xI", size, 0x02400000) + b"mntrRGB XYZ " + bytes(12) + b"acsp"
    head = head.ljust(68, b"\0") + xyz((0.9642, 1, 0.8249))[8:]
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


def in_srgb(colour):
    """Convert an 8-bit colour from the profile to sRGB; it must lie inside sRGB."""
    linear = np.linalg.solve(SRGB, P3 @ (np.array(colour) / 255) ** GAMMA)
    curve = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return 255 * curve
