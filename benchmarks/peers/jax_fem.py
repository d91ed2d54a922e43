"""Assembly in jax-fem: `python -I jax_fem.py FOLDER`.

jax-fem is GPL: it is only ever run as this separate program. Its solvers need PETSc; its
assembly does not, the sum of equal entries is left to SciPy as it does itself.
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
from jax_fem.generate_mesh import Mesh  # noqa: E402
from jax_fem.problem import Problem  # noqa: E402

NAMES = {"Tri3": "TRI3", "Quad4": "QUAD4", "Tet10": "TET10", "Hex8": "HEX8"}


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

    name = NAMES[request["element"]]
    mesh = Mesh(arrays["points"], arrays["cells"], ele_type=name)
    return Rubber(mesh, vec=dim, dim=dim, ele_type=name)


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


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
