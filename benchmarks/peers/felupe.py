"""Pressure, assembly and Newton's method in felupe: `python -I felupe.py FOLDER`.

felupe is GPL: it is only ever run as this separate program.
"""

import json
import sys
import time
from pathlib import Path

import felupe as fem
import numpy as np
import scipy.sparse as sp

try:
    from pypardiso import spsolve

    SOLVER = "pardiso"
except ImportError:
    from scipy.sparse.linalg import spsolve

    SOLVER = "superlu"


def repair_quadratic_triangle():
    """felupe 11.3 has d h5 / ds = 4 (t - r) of the mid-side node 5; 4 (t - s) is right."""

    def gradient(self, rs):
        r, s = rs
        t = 1 - r - s
        return np.array(
            [
                [1 - 4 * t, 1 - 4 * t],
                [4 * r - 1, 0],
                [0, 4 * s - 1],
                [4 * (t - r), -4 * r],
                [4 * s, 4 * r],
                [-4 * s, 4 * (t - s)],
            ]
        )

    fem.element.QuadraticTriangle.gradient = gradient


def area_matrix(edges, num_dofs):
    """B with enclosed area x' B x / 2, for quadratic edges (corner, corner, mid).

    Edges run so that the enclosed area is positive; p B x is the force of pressure p.
    """
    # Integral of N_i dN_j over an edge, nodes ordered corner, corner, mid.
    moment = np.array([[-1 / 2, -1 / 6, 2 / 3], [1 / 6, 1 / 2, -2 / 3], [-2 / 3, 2 / 3, 0]])
    curl = (moment - moment.T) / 2  # the symmetric part is a term at the ends: it cancels
    i = np.repeat(edges, 3, axis=1).ravel()
    j = np.tile(edges, 3).ravel()
    values = np.tile(curl.ravel(), len(edges))
    shape = (num_dofs, num_dofs)
    return (
        sp.coo_matrix((values, (2 * i, 2 * j + 1)), shape)
        + sp.coo_matrix((-values, (2 * i + 1, 2 * j)), shape)
    ).tocsr()


def pressure(request, arrays):
    """Displacements at every pressure of `levels`, by Newton from level to level.

    Arrays: `points` (nodes, 2), `cells` (cells, 6: corners, then mid-sides 01 12 20),
    `part` (cells,), `mu` and `bulk` per part, `fixed` dofs, cavity `edges`, `levels`.
    """
    repair_quadratic_triangle()
    start = time.perf_counter()
    points, load = arrays["points"], area_matrix(arrays["edges"], arrays["points"].size)
    bodies = [body(arrays, k) for k in range(len(arrays["mu"]))]
    free = np.setdiff1d(np.arange(points.size), arrays["fixed"])
    u, found, iterations = np.zeros_like(points), [], 0
    for level in arrays["levels"]:
        for _ in range(request.get("max_iterations", 60)):
            residual, tangent = assemble(bodies, u)
            residual = residual - level * (load @ (points + u).ravel())
            tangent = (tangent - level * load).tocsr()[free][:, free]
            step = np.zeros(points.size)
            step[free] = spsolve(tangent, -residual[free])
            u, iterations = u + step.reshape(u.shape), iterations + 1
            if not np.all(np.isfinite(u)):
                sys.exit(f"felupe: Newton diverged at pressure {level:g}")
            if np.linalg.norm(step) <= request["tolerance"] * np.linalg.norm(u):
                break
        else:
            sys.exit(f"felupe: no convergence at pressure {level:g}")
        found.append(u)
    seconds = time.perf_counter() - start
    answer = {"compile_s": 0.0, "runs": [seconds], "iterations": iterations}
    return answer | {"solver": SOLVER}, {"displacement": np.array(found)}


def body(arrays, part):
    cells = arrays["cells"][arrays["part"] == part]
    mesh = fem.Mesh(arrays["points"], cells, "triangle6")
    rule = fem.TriangleQuadrature(order=5)
    field = fem.FieldPlaneStrain(fem.RegionQuadraticTriangle(mesh, quadrature=rule), dim=2)
    material = fem.NeoHooke(mu=arrays["mu"][part], bulk=arrays["bulk"][part])
    return fem.SolidBody(material, fem.FieldContainer([field]))


def assemble(bodies, u):
    residual, tangent = 0.0, 0.0
    for solid in bodies:
        solid.field[0].values[:] = u
        residual = residual + solid.assemble.vector(solid.field).toarray().ravel()
        tangent = tangent + solid.assemble.matrix(solid.field)
    return residual, tangent


REGIONS = {
    "Tri3": (fem.RegionTriangle, "triangle", {}),
    "Quad4": (fem.RegionQuad, "quad", {}),
    "Tri6": (
        fem.RegionQuadraticTriangle,
        "triangle6",
        {"quadrature": fem.TriangleQuadrature(order=5)},
    ),
    "Tet10": (fem.RegionQuadraticTetra, "tetra10", {}),
    "Hex8": (fem.RegionHexahedron, "hexahedron", {}),
}


def solid_body(request, arrays):
    """One material on all cells, in plane strain or in space."""
    repair_quadratic_triangle()
    region, kind, options = REGIONS[request["element"]]
    made = region(fem.Mesh(arrays["points"], arrays["cells"], kind), **options)
    plane = arrays["points"].shape[1] == 2
    field = fem.FieldPlaneStrain(made, dim=2) if plane else fem.Field(made, dim=3)
    material = fem.NeoHooke(mu=request["mu"], bulk=request["bulk"])
    return fem.SolidBody(material, fem.FieldContainer([field]))


def assembly(request, arrays):
    """CPU seconds of residual and tangent, scatter included, at the displacement `u`."""
    solid = solid_body(request, arrays)
    assemble([solid], arrays["u"])
    runs = []
    for _ in range(request["repeats"]):
        start = time.process_time()
        residual, tangent = assemble([solid], arrays["u"])
        runs.append(time.process_time() - start)
    way = arrays["way"].ravel()
    upper = sp.triu(tangent, 1)
    return {"compile_s": 0.0, "runs": runs}, {"residual": residual, "product": tangent @ way,
                                             "entries": upper.nnz}  # fmt: skip


def newton(request, arrays):
    """CPU seconds of one Newton iteration: assembly, supports, factorisation, solution.

    Arrays: `points`, `cells`, `fixed` dofs, and the dead nodal `force`.
    """
    solid, force = solid_body(request, arrays), arrays["force"].ravel()
    free = np.setdiff1d(np.arange(force.size), arrays["fixed"])
    runs = []
    for _ in range(request["repeats"]):
        u, start = np.zeros_like(arrays["points"]), time.process_time()
        for _ in range(request["iterations"]):
            residual, tangent = assemble([solid], u)
            step = np.zeros(force.size)
            rhs = (force - residual)[free]
            step[free] = spsolve(tangent[free][:, free], rhs)
            u = u + step.reshape(u.shape)
        runs.append((time.process_time() - start) / request["iterations"])
    return {"compile_s": 0.0, "runs": runs, "solver": SOLVER}, {"displacement": u}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
