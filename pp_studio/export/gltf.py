"""Writes glTF 2.0 as one binary file (GLB): points, Gaussians or triangles with attributes."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.files import atomic_file, srgb_to_linear

POINTS, TRIANGLES = 0, 4  # modes of a primitive
UNLIT = "KHR_materials_unlit"  # the colours already contain the light of the photographs
TYPES = {np.dtype("f4"): 5126, np.dtype("u2"): 5123, np.dtype("u4"): 5125}


def write_glb(
    path: Path | str,
    attributes: dict[str, np.ndarray],
    *,
    faces: np.ndarray | None = None,
    extension: tuple[str, dict[str, Any]] | None = None,
    extras: dict[str, Any] | None = None,
) -> None:
    """Write vertices. attributes: {name: (M,) or (M, K) array of float32, or of uint16 for 0 to 1},
    which includes POSITION (M, 3), in world coordinates. faces: (F, 3) vertices of triangles; None:
    points. extension: name and JSON of the primitive's extension. extras: JSON of the mesh. Raises
    UserError as atomic_file does.

    glTF stores positions as float32, so float64 positions are moved to the origin, and the file's
    node moves them back.
    """
    place, arrays = attributes["POSITION"], dict(attributes)
    origin = np.rint(place.mean(0)) if place.dtype == np.float64 else np.zeros(3)
    arrays["POSITION"] = place = (place - origin).astype(np.float32)
    names = {name: i for i, name in enumerate(arrays)}
    primitive: dict[str, Any] = {"mode": POINTS, "attributes": names}
    if faces is not None:
        primitive |= {"mode": TRIANGLES, "indices": len(names), "material": 0}
        arrays[""] = np.asarray(faces, np.uint32).ravel()
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    content = b""
    for array in arrays.values():
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        about = {"componentType": TYPES[array.dtype], "normalized": array.dtype == np.uint16}
        accessors.append({"bufferView": len(views), **about, "type": kind, "count": len(array)})
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": array.nbytes})
        content += array.tobytes()
    least, most = place.min(0).tolist(), place.max(0).tolist()
    accessors[names["POSITION"]] |= {"min": least, "max": most}
    gltf: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "pp-cl"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": origin.tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    if faces is not None:  # without a material, viewers show metal
        gltf["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0}}]
        make_unlit(gltf)
    if extras:
        gltf["meshes"][0]["extras"] = extras
    if extension:
        primitive["extensions"] = dict([extension])
        gltf["extensionsUsed"] = [extension[0]]
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(content)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(content), b"BIN\0") + content)


def make_unlit(gltf: dict[str, Any]) -> None:
    """Mark a glTF document's materials as unlit, for viewers that support this."""
    for material in gltf.get("materials", ()):
        material["extensions"] = {UNLIT: {}}
    gltf["extensionsUsed"] = [*gltf.get("extensionsUsed", ()), UNLIT]


def gltf_colours(colours: np.ndarray) -> np.ndarray:
    """(M, 4) uint16 linear RGBA of sRGB (M, 3) clipped to [0, 1]. glTF 2.0 stores vertex colours in
    linear light, where 8 bits would hold only 6 of the 40 darkest levels of sRGB.
    """
    linear = np.rint(65535 * srgb_to_linear(colours.clip(0, 1))).astype(np.uint16)
    return np.column_stack([linear, np.full(len(colours), 65535, np.uint16)])
