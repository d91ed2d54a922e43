"""The solid of `benchmarks.csg` in fogleman/sdf, as packaged in sdf-fork:
`python -I sdf_fork.py FOLDER`.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import sdf


def solid():
    rod = sdf.cylinder(0.5)
    body = sdf.sphere(1) & sdf.box(1.5)
    return body - (rod.orient(sdf.X) | rod.orient(sdf.Y) | rod.orient(sdf.Z))


def value(request, arrays):
    """The field at `points`."""
    shape, runs = solid(), []
    for _ in range(request["repeats"]):
        start = time.perf_counter()
        field = shape(arrays["points"])
        runs.append(time.perf_counter() - start)
    return {"compile_s": 0.0, "runs": runs}, {"field": field.ravel()}


def surface(request, arrays):
    """Corners of triangles, three in a row, on cells of a cube about the origin."""
    shape, runs, half = solid(), [], request["side"] / 2
    for _ in range(request["repeats"]):
        start = time.perf_counter()
        found = shape.generate(
            step=request["side"] / request["cells"],
            bounds=((-half,) * 3, (half,) * 3),
            workers=1,
            verbose=False,
        )
        runs.append(time.perf_counter() - start)
    return {"compile_s": 0.0, "runs": runs}, {"corners": np.array(found)}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
