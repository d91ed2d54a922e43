"""GLB (binary glTF 2.0): for viewers on the web."""

import json
from typing import BinaryIO

import numpy as np

from sorojax.sdf import Surface

_FLOAT, _UINT = 5126, 5125


def write(file: BinaryIO, surface: Surface) -> None:
    """One mesh in metres, turned so that z points up in viewers, where y does."""
    points = surface.vertices.astype("<f4")
    rows = surface.triangles.astype("<u4")
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes, "target": 34962},
        {"buffer": 0, "byteOffset": points.nbytes, "byteLength": rows.nbytes, "target": 34963},
    ]
    position = {
        "bufferView": 0, "componentType": _FLOAT, "count": len(points), "type": "VEC3",
        "min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist(),
    }  # fmt: skip
    index = {"bufferView": 1, "componentType": _UINT, "count": rows.size, "type": "SCALAR"}
    scene = {
        "asset": {"version": "2.0", "generator": "sorojax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [position, index],
        "bufferViews": views,
        "buffers": [{"byteLength": points.nbytes + rows.nbytes}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    body = points.nbytes + rows.nbytes
    header = np.array([0x46546C67, 2, 12 + 8 + len(text) + 8 + body], "<u4")
    file.write(header.tobytes() + np.array([len(text), 0x4E4F534A], "<u4").tobytes() + text)
    file.write(np.array([body, 0x004E4942], "<u4").tobytes())
    file.write(points.tobytes())
    file.write(rows.tobytes())
