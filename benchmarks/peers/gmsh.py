"""Triangles and tetrahedra of gmsh: `python -I gmsh.py FOLDER`.

gmsh is GPL: it is only ever run as this separate program.
"""

import json
import sys
import time
from pathlib import Path

import gmsh
import numpy as np


def triangles(request, arrays):
    """A polygon `outer` less a polygon `inner`, in cells of `size`."""

    def draw():
        loops = [_loop(arrays[name], request["size"]) for name in ("outer", "inner")]
        gmsh.model.geo.addPlaneSurface(loops)
        gmsh.model.geo.synchronize()

    return _meshed(request, draw, 2)


def balls(request, arrays):
    """A ball of radius `outer`, less one of radius `inner` if that is not zero."""

    def draw():
        body = gmsh.model.occ.addSphere(0, 0, 0, request["outer"])
        if request["inner"]:
            hole = gmsh.model.occ.addSphere(0, 0, 0, request["inner"])
            gmsh.model.occ.cut([(3, body)], [(3, hole)])
        gmsh.model.occ.synchronize()

    return _meshed(request, draw, 3)


def _loop(corners, size):
    points = [gmsh.model.geo.addPoint(x, y, 0, size) for x, y in corners]
    ends = zip(points, points[1:] + points[:1], strict=True)
    return gmsh.model.geo.addCurveLoop([gmsh.model.geo.addLine(a, b) for a, b in ends])


def _meshed(request, draw, dim):
    """Seconds of geometry and mesh together, and the mesh."""
    runs = []
    for _ in range(request["repeats"]):
        start = time.perf_counter()
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        gmsh.option.setNumber("Mesh.MeshSizeMin", request["size"])
        gmsh.option.setNumber("Mesh.MeshSizeMax", request["size"])
        gmsh.option.setNumber("Mesh.Algorithm", 6)  # frontal
        gmsh.option.setNumber("Mesh.Optimize", 1)
        draw()
        gmsh.model.mesh.generate(dim)
        tags, points, _ = gmsh.model.mesh.getNodes()
        _, cells = gmsh.model.mesh.getElementsByType(2 if dim == 2 else 4)
        runs.append(time.perf_counter() - start)
        gmsh.finalize()
    rows = np.zeros(int(max(tags)) + 1, int)
    rows[tags.astype(int)] = np.arange(len(tags))
    cells = rows[cells.astype(int)].reshape(-1, dim + 1)
    used, cells = np.unique(cells, return_inverse=True)
    points = points.reshape(-1, 3)[used, :dim]
    answer = {"points": points, "cells": cells.reshape(-1, dim + 1)}
    return {"compile_s": 0.0, "runs": runs}, answer


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
