"""Read glTF 2.0 files without a library, which would add missing parts."""

import json
import struct

import numpy as np


def glb(path):
    """(JSON, {attribute: array}) of a .glb file."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    gltf, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert struct.unpack_from("<I4s", data, 20 + size) == (len(body), b"BIN\0")
    arrays = {}
    for name, i in gltf["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = gltf["accessors"][i]
        view = gltf["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert accessor.get("normalized", False) == (dtype == "<u2")
        values = np.frombuffer(
            body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], dtype
        )
        arrays[name] = values.reshape(accessor["count"], width)
    return gltf, arrays
