"""Moving surfaces as binary glTF 2.0 (GLB), for Blender, viewers on the web and slides: morph
targets for shapes, node poses for bodies.
"""

import json
import os
from collections.abc import Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sorojax import _check
from sorojax.io import _files

_FLOAT, _UINT, _SHORT, _UBYTE = 5126, 5125, 5122, 5121
ARRAY, _INDEX = 34962, 34963
UPRIGHT = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # z up becomes y up


class MovingSurface(NamedTuple):
    """A surface through all frames.

    Attributes:
        points: In every frame, or once if it keeps its shape [m].
        triangles: Rows of points.
        poses: Homogeneous matrices that place it in every frame [m], or None.
        colours: Red, green and blue of each point as a screen takes them, in [0, 1], or of
            all.
        name: Of the node.
    """

    points: Float[np.ndarray, "frames points 3"]
    triangles: Int[np.ndarray, "triangles 3"]
    poses: Float[np.ndarray, "frames 4 4"] | None
    colours: Float[np.ndarray, "*points 3"]
    name: str


class Document:
    """The pieces of a file, and the bytes that they refer to."""

    def __init__(self) -> None:
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.body: list[bytes] = []
        self.size = 0

    def view(self, data: np.ndarray, target: int | None = None, stride: int = 0) -> int:
        content = np.ascontiguousarray(data).tobytes()
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": self.size,
            "byteLength": len(content),
        }
        view |= {"target": target} if target else {}
        view |= {"byteStride": stride} if stride else {}
        self.views.append(view)
        padded = content + bytes(-len(content) % 4)
        self.body.append(padded)
        self.size += len(padded)
        return len(self.views) - 1

    def accessor(self, view: int, kind: int, count: int, of: str, **more: Any) -> int:
        entry = {"bufferView": view, "componentType": kind, "count": count, "type": of}
        self.accessors.append(entry | more)
        return len(self.accessors) - 1

    def floats(
        self, data: np.ndarray, of: str, ends: bool = False, target: int | None = None
    ) -> int:
        data = np.asarray(data, "<f4")
        rows = data.reshape(len(data), -1)
        more = {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()} if ends else {}
        count = data.size if of == "SCALAR" else len(data)
        return self.accessor(self.view(data, target), _FLOAT, count, of, **more)

    def indices(self, triangles: np.ndarray) -> int:
        rows = np.asarray(triangles, "<u4")
        return self.accessor(self.view(rows, _INDEX), _UINT, rows.size, "SCALAR")

    def write(self, file: BinaryIO, nodes: list, meshes: list, **more: Any) -> None:
        """The file, which shows the last of the nodes."""
        scene = {
            "asset": {"version": "2.0", "generator": "sorojax"},
            "scene": 0,
            "scenes": [{"nodes": [len(nodes) - 1]}],
            "nodes": nodes,
            "meshes": meshes,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.size}],
        }
        text = json.dumps(scene | more, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self.size
        head = np.array([0x46546C67, 2, total, len(text), 0x4E4F534A], "<u4")
        file.write(head.tobytes() + text)
        file.write(np.array([self.size, 0x004E4942], "<u4").tobytes())
        file.writelines(self.body)


def write(
    file: BinaryIO, shapes: Sequence[MovingSurface], times: Float[np.ndarray, " frames"]
) -> None:
    """Shapes in metres, turned so that z points up in viewers, where y does.

    Points are stored at 16 bits in the box of their motion (KHR_mesh_quantization), which a
    node scales back; between two frames viewers interpolate.
    """
    document = Document()
    nodes, meshes, channels, samplers = [], [], [], []
    clock = document.floats(times, "SCALAR", ends=True) if len(times) > 1 else -1

    def animate(node: int, path: str, data: np.ndarray, of: str) -> None:
        samplers.append({"input": clock, "output": document.floats(data, of)})
        target = {"node": node, "path": path}
        channels.append({"sampler": len(samplers) - 1, "target": target})

    for shape in shapes:
        mesh, centre, half = _mesh(document, shape)
        meshes.append(mesh)
        scaled = len(nodes)
        node = {"mesh": len(meshes) - 1, "name": shape.name}
        nodes.append(node | {"translation": centre.tolist(), "scale": half.tolist()})
        if len(shape.points) > 1:
            frames = len(shape.points)
            animate(scaled, "weights", np.eye(frames)[:, 1:], "SCALAR")
        carrier: dict[str, Any] = {"children": [scaled], "name": f"{shape.name} pose"}
        nodes.append(carrier)
        if shape.poses is None:
            continue
        turns, places = _quaternions(shape.poses[:, :3, :3]), shape.poses[:, :3, 3]
        carrier |= {"rotation": turns[0].tolist(), "translation": places[0].tolist()}
        if len(shape.poses) > 1:
            animate(scaled + 1, "rotation", turns, "VEC4")
            animate(scaled + 1, "translation", places, "VEC3")
    carriers = list(range(1, len(nodes), 2))
    nodes.append({"rotation": UPRIGHT, "children": carriers, "name": "sorojax"})
    rough = {"metallicFactor": 0.0, "roughnessFactor": 0.7}
    more: dict[str, Any] = {
        "extensionsUsed": ["KHR_mesh_quantization"],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "materials": [{"pbrMetallicRoughness": rough, "doubleSided": True}],
    }
    if channels:
        more["animations"] = [{"channels": channels, "samplers": samplers, "name": "motion"}]
    document.write(file, nodes, meshes, **more)


def _mesh(document: Document, shape: MovingSurface):
    """A mesh with a morph target per later frame, and the box that scales it back."""
    points = shape.points
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    centre, half = (low + high) / 2, (high - low) / 2
    half = np.where(half > 0, half, max(half.max(), 1e-9))
    levels = np.rint(32767 * np.clip((points - centre) / half, -1, 1)).astype(np.int32)
    index = document.indices(shape.triangles)
    colours = np.broadcast_to(shape.colours, points.shape[1:]) ** 2.2  # the file's are linear
    colours = np.rint(255 * np.pad(colours, ((0, 0), (0, 1)), constant_values=1.0))
    shades = document.view(colours.astype(np.uint8), ARRAY, stride=4)
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": _shorts(document, levels[0]),
            "COLOR_0": document.accessor(shades, _UBYTE, len(colours), "VEC4", normalized=True),
        },
        "indices": index,
        "material": 0,
    }
    targets = [_steps(document, frame - levels[0]) for frame in levels[1:]]
    mesh: dict[str, Any] = {"primitives": [primitive], "name": shape.name}
    if targets:
        primitive["targets"] = [{"POSITION": target} for target in targets]
        mesh["weights"] = [0.0] * len(targets)
    return mesh, centre, half


def _shorts(document: Document, levels: Int[np.ndarray, "points 3"]) -> int:
    """Normalised 16-bit numbers, each row on a multiple of four bytes."""
    wide = np.pad(levels, ((0, 0), (0, 1))).astype("<i2")
    view = document.view(wide, ARRAY, stride=8)
    ends = {"min": levels.min(0).tolist(), "max": levels.max(0).tolist()}
    return document.accessor(view, _SHORT, len(levels), "VEC3", normalized=True, **ends)


def _steps(document: Document, steps: Int[np.ndarray, "points 3"]) -> int:
    """Displacements of a morph target; as floats where they leave 16 bits."""
    if np.abs(steps).max() <= 32767:
        return _shorts(document, steps)
    return document.floats(steps / 32767, "VEC3", ends=True)


def _quaternions(rotations: Float[np.ndarray, "frames 3 3"]) -> Float[np.ndarray, "frames 4"]:
    """Unit quaternions, scalar last, neighbours on the same side."""
    R = rotations
    trace = np.trace(R, axis1=1, axis2=2)
    own = 1 + 2 * np.diagonal(R, axis1=1, axis2=2) - trace[:, None]
    squares = np.maximum(np.concatenate([own, 1 + trace[:, None]], axis=1), 0) / 4
    products = {
        (0, 1): R[:, 0, 1] + R[:, 1, 0], (0, 2): R[:, 0, 2] + R[:, 2, 0],
        (1, 2): R[:, 1, 2] + R[:, 2, 1], (0, 3): R[:, 2, 1] - R[:, 1, 2],
        (1, 3): R[:, 0, 2] - R[:, 2, 0], (2, 3): R[:, 1, 0] - R[:, 0, 1],
    }  # fmt: skip
    outer = np.zeros((len(R), 4, 4))
    outer[:, range(4), range(4)] = squares
    for (i, j), value in products.items():
        outer[:, i, j] = outer[:, j, i] = value / 4
    # The row with the largest entry of q q' is q times that entry's root.
    row = outer[np.arange(len(R)), np.argmax(squares, axis=1)]
    q = row / np.linalg.norm(row, axis=1, keepdims=True)
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(flips)[:, None]
    return q


# Moving surfaces to GLB files, for Blender, viewers on the web and slides


def export_animation(
    path: str | os.PathLike,
    shapes: Sequence[MovingSurface],
    times: Float[np.ndarray, " frames"],
    *,
    root: str | os.PathLike | None = None,
) -> None:
    """Write moving surfaces as GLB, whole or not at all.

    A surface that changes shape has one morph target per frame, one that moves rigidly a
    pose per frame. `view.to_glb` makes the shapes from results.

    Args:
        path: File name, ending in .glb.
        shapes: The surfaces [m].
        times: Instants of the frames, rising [s].
        root: Folder that the file must lie in, links followed.

    Raises:
        ValueError: If the ending is another, a number of frames does not fit, numbers are
            not finite or times do not rise.
    """
    where = "export_animation"
    file = _files.inside(where, path, root)
    if file.suffix.lower() != ".glb":
        raise ValueError(f"{where}: the file name ends in `{file.suffix}`, need .glb.")
    times = np.asarray(times, float)
    if times.ndim != 1 or np.any(np.diff(times) <= 0) or not len(shapes):
        raise ValueError(
            f"{where}: got {len(shapes)} shapes and times of shape {times.shape}, need one "
            "shape or more and times that rise strictly."
        )
    _check.finite(where, "times", times, "Give seconds.")
    for shape in shapes:
        _check.finite(where, "points", shape.points, "Cut the motion where it failed.")
        counts = {len(part) for part in (shape.points, shape.poses) if part is not None}
        if counts - {1, len(times)}:
            raise ValueError(
                f"{where}: `{shape.name}` has {sorted(counts)} frames, need {len(times)} or 1. "
                "Give one time per frame."
            )
    _files.write(file, lambda stream: write(stream, shapes, times))
