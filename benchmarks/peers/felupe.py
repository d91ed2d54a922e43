"""Pressure, assembly and Newton's method in felupe: `python -I felupe.py FOLDER`.

felupe is GPL: it is only ever run as this separate program.
"""

import json
import os
import sys
import time
from pathlib import Path

import felupe as fem
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

try:
    from pypardiso import spsolve

    SOLVER = "pardiso"
except ImportError:
    from scipy.sparse.linalg import spsolve

    SOLVER = "superlu"

clock = time.process_time if os.environ.get("SOROJAX_BENCH_CPU") == "1" else time.perf_counter


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
    start = clock()
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
    seconds = clock() - start
    answer = {"compile_s": 0.0, "runs": [seconds], "iterations": iterations}
    return answer | {"solver": SOLVER}, {"displacement": np.array(found)}


def motion(request, arrays):
    """A body on the floor y = 0 in motion: generalised-alpha, Newton, line search; CPU seconds.

    Arrays: those of `pressure` without `levels`, cavity k in `edges_k` and the pressures at
    the ends of steps in `pressures`; upper triangles `mass` and `damping` on `rows`, `cols`;
    `weight` of every unknown; `touching` edges and the `areas` of their three points.
    """
    repair_quadratic_triangle()
    points, h, rho = arrays["points"], request["step"], request["rho_inf"]
    size, at = points.size, (arrays["rows"], arrays["cols"])
    uppers = [sp.coo_matrix((arrays[name], at), (size, size)) for name in ("mass", "damping")]
    mass, damping = ((upper + sp.triu(upper, 1).T).tocsr() for upper in uppers)
    levels = arrays["pressures"]
    air = [area_matrix(arrays[f"edges_{k}"], size) for k in range(levels.shape[1])]
    bodies = [body(arrays, k, request["element"]) for k in range(len(arrays["mu"]))]
    solve = spsolve if request["solver"] == "pardiso" else scipy.sparse.linalg.spsolve
    af, am = rho / (1 + rho), (2 * rho - 1) / (1 + rho)
    beta, gamma = (1 - am + af) ** 2 / 4, 0.5 - am + af
    u, v, a = np.zeros((3, size))
    floor, X, iterations = Floor(arrays, request), points.ravel(), 0
    start, ends = time.process_time(), []
    for before, after in zip(levels[:-1], levels[1:], strict=True):
        shares = (1 - af) * after + af * before
        load = sum((p * B for p, B in zip(shares, air, strict=True)), start=0 * mass)
        floor.begin(X + u, h)
        new = u + h * v

        def unbalanced(new, u=u, v=v, a=a, load=load):
            middle = (1 - af) * new + af * u
            a_new = (new - u - h * v) / (beta * h**2) - (1 / (2 * beta) - 1) * a
            v_new = v + h * ((1 - gamma) * a + gamma * a_new)
            inertia = mass @ ((1 - am) * a_new + am * a)
            drag = damping @ ((1 - af) * v_new + af * v)
            push = load @ (X + middle) + arrays["weight"] + floor.assemble(X + new)[0]
            return inertia + drag + inner(bodies, middle.reshape(points.shape)) - push

        residual = unbalanced(new)
        for _ in range(request["max_iterations"]):
            middle = (1 - af) * new + af * u
            _, tangent = assemble(bodies, middle.reshape(points.shape))
            whole = (1 - am) / (beta * h**2) * mass + (1 - af) * gamma / (beta * h) * damping
            whole = whole + (1 - af) * (tangent - load) + floor.assemble(X + new)[1]
            step, share = solve(whole.tocsc(), -residual), 1.0
            slope = -float(residual @ step)
            for _ in range(12):  # shortened where it runs past the kink of a contact
                residual = unbalanced(new + share * step)
                end = float(residual @ step)
                if not end > 0.5 * slope > 0:
                    break
                share *= slope / (slope + end)
            new, iterations = new + share * step, iterations + 1
            if np.abs(step).max() <= request["tolerance"] * np.abs(new).max():
                break
            if not np.all(np.isfinite(new)):
                sys.exit("felupe: Newton diverged")
        else:
            sys.exit(f"felupe: no convergence in step {len(ends)}")
        a_new = (new - u - h * v) / (beta * h**2) - (1 / (2 * beta) - 1) * a
        v, u, a = v + h * ((1 - gamma) * a + gamma * a_new), new, a_new
        ends.append(u.reshape(points.shape))
    answer = {"compile_s": 0.0, "runs": [time.process_time() - start]}
    return answer | {"iterations": iterations}, {"displacement": np.array(ends)}


class Floor:
    """Penalty and spring-slider of `sorojax.contact` at three points of quadratic edges."""

    def __init__(self, arrays, request):
        x = np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
        shape = np.stack([x * (x - 1) / 2, x * (x + 1) / 2, 1 - x**2], axis=1)
        edges, num = arrays["touching"], arrays["areas"].size
        rows = np.repeat(np.arange(num), 3)
        nodes = np.repeat(edges, 3, axis=0).ravel()
        values = np.tile(shape.ravel(), len(edges))
        size = (num, arrays["points"].size)
        self.x, self.y = (
            sp.coo_matrix((values, (rows, 2 * nodes + k)), size).tocsr() for k in (0, 1)
        )
        self.areas, self.of = arrays["areas"].ravel(), request
        self.anchor, self.limit, self.drag = np.zeros((3, num))
        self.place = self.x @ arrays["points"].ravel()
        self.anchor = self.place.copy()

    def begin(self, at, h):
        """What friction of a step knows: anchor, largest traction, dashpot."""
        place = self.x @ at
        pull = self.drag * (self.place - self.anchor) + self.traction(place)[0]
        self.anchor = place - pull / (self.of["stiffness"] + self.drag)
        self.limit = self.of["friction"] * self.pressure(self.y @ at)[0]
        self.drag, self.place = self.limit / (h * self.of["friction_velocity"]), place

    def pressure(self, gap):
        stiffness, width = self.of["stiffness"], self.of["smoothing"]
        ramp = np.clip(-gap, 0, width)
        value = stiffness * (ramp**2 / (2 * width) + np.maximum(-gap, 0) - ramp)
        return value, stiffness * ramp / width

    def traction(self, place):
        stiffness = self.of["stiffness"]
        trial = stiffness * (place - self.anchor) + self.drag * (place - self.place)
        held = np.abs(trial) <= self.limit
        value = np.where(held, trial, np.sign(trial) * self.limit)
        return value, np.where(held, stiffness + self.drag, 0.0)

    def assemble(self, at):
        pressure, steep = self.pressure(self.y @ at)
        traction, grip = self.traction(self.x @ at)
        force = self.y.T @ (self.areas * pressure) - self.x.T @ (self.areas * traction)
        across = self.y.T @ sp.diags(self.areas * steep) @ self.y
        return force, across + self.x.T @ sp.diags(self.areas * grip) @ self.x


def body(arrays, part, element="Tri6"):
    region, kind, options = REGIONS[element]
    mesh = fem.Mesh(arrays["points"], arrays["cells"][arrays["part"] == part], kind)
    field = fem.FieldPlaneStrain(region(mesh, **options), dim=2)
    material = fem.NeoHooke(mu=arrays["mu"][part], bulk=arrays["bulk"][part])
    return fem.SolidBody(material, fem.FieldContainer([field]))


def inner(bodies, u):
    """Internal force alone."""
    total = 0.0
    for solid in bodies:
        solid.field[0].values[:] = u
        total = total + solid.assemble.vector(solid.field).toarray().ravel()
    return total


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
    "Quad8": (fem.RegionQuadraticQuad, "quad8", {}),
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
    return {"compile_s": 0.0, "runs": runs}, {
        "residual": residual,
        "product": tangent @ way,
        "entries": upper.nnz,
    }


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
