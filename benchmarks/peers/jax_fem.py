"""Assembly and Newton's method in jax-fem: `python -I jax_fem.py FOLDER`.

jax-fem is GPL: it is only ever run as this separate program. Its solvers need PETSc; its
assembly does not, the sum of equal entries is left to SciPy as it does itself. Newton's method
here is its loop with SciPy's direct solver.
"""

import json
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import scipy.sparse as sp  # noqa: E402
import scipy.sparse.linalg as spl  # noqa: E402
from jax_fem.generate_mesh import Mesh  # noqa: E402
from jax_fem.problem import Problem  # noqa: E402

NAMES = {"Tri3": "TRI3", "Tri6": "TRI6", "Quad4": "QUAD4", "Tet10": "TET10", "Hex8": "HEX8"}


def body(request, arrays):
    mu, bulk = request["mu"], request["bulk"]
    dim = arrays["points"].shape[1]

    def energy(F):
        J = jnp.linalg.det(F)
        first = jnp.sum(F * F) + (3 - dim)
        return mu / 2 * (first * J ** (-2 / 3) - 3) + bulk / 2 * (J - 1) ** 2

    class Rubber(Problem):
        def get_tensor_map(self):
            stress = jax.grad(energy)
            return lambda gradient: stress(gradient + jnp.eye(dim))

    class Heavy(Rubber):
        def get_mass_map(self):
            weight = jnp.asarray(arrays["weight"])
            return lambda u, x: -weight

    name, kind = NAMES[request["element"]], Heavy if "weight" in arrays else Rubber
    mesh = Mesh(arrays["points"], arrays["cells"], ele_type=name)
    return kind(mesh, vec=dim, dim=dim, ele_type=name, gauss_order=request.get("degree"))


def assembly(request, arrays):
    """CPU seconds of residual and tangent at the displacement `u`."""
    solid, u = body(request, arrays), [jnp.asarray(arrays["u"])]
    size = arrays["points"].size

    def assemble():
        residual = solid.newton_update(u)
        jax.block_until_ready(residual)
        values = np.asarray(solid.V)
        return sp.csr_array((values, (np.asarray(solid.I), np.asarray(solid.J))), (size, size))

    start = time.perf_counter()
    matrix, runs = assemble(), []
    first = time.perf_counter() - start
    for _ in range(request["repeats"]):
        start = time.process_time()
        assemble()
        runs.append(time.process_time() - start)
    product = matrix @ arrays["way"].ravel()
    return {"compile_s": max(0.0, first - min(runs)), "runs": runs}, {"product": product}


def first_calls(request, arrays):
    """Seconds of the first solve under a weight and of the second, from zero; `fixed` dofs."""
    solid = body(request, arrays)
    shape, size = arrays["points"].shape, arrays["points"].size
    free = np.setdiff1d(np.arange(size), arrays["fixed"])
    jax.block_until_ready(jnp.zeros(3) + 1)

    def solve():
        u, iterations = np.zeros(size), 0
        while iterations < request["max_iterations"]:
            (residual,) = solid.newton_update([jnp.asarray(u.reshape(shape))])
            unbalanced = np.asarray(residual).ravel()[free]
            entries = (np.asarray(solid.V), (np.asarray(solid.I), np.asarray(solid.J)))
            tangent = sp.csr_array(entries, (size, size))[free][:, free]
            step = np.zeros(size)
            step[free] = spl.spsolve(tangent.tocsc(), -unbalanced)
            u, iterations = u + step, iterations + 1
            if np.linalg.norm(step) <= request["tolerance"] * np.linalg.norm(u):
                return u.reshape(shape), iterations
        sys.exit(f"jax_fem: no convergence in {iterations} iterations")

    seconds, cpu = [], []
    for _ in range(2):
        start = time.perf_counter(), time.process_time()
        u, iterations = solve()
        seconds.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return {"seconds": seconds, "cpu": cpu, "iterations": iterations}, {"result": u}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
