"""Assembly in torch-fem: `python -I torch_fem.py FOLDER`."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
import torchfem
from torchfem.materials import Hyperelastic3D, HyperelasticPlaneStrain

torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)


def body(request, arrays):
    mu, bulk = request["mu"], request["bulk"]

    def energy(F, _):
        J = torch.linalg.det(F)
        first = torch.sum(F * F) + (3 - F.shape[-1])
        return mu / 2 * (first * J ** (-2 / 3) - 3) + bulk / 2 * (J - 1) ** 2

    points, cells = torch.tensor(arrays["points"]), torch.tensor(arrays["cells"])
    if points.shape[1] == 3:
        return torchfem.Solid(points, cells, Hyperelastic3D(energy, torch.tensor([])))
    material = HyperelasticPlaneStrain(energy, torch.tensor([]))
    return torchfem.Planar(points, cells, material)


def assembly(request, arrays):
    """CPU seconds of residual and tangent at the displacement `u`."""
    solid = body(request, arrays)
    u = torch.tensor(arrays["u"])
    flux = (solid.n_int, solid.n_elem, *solid.n_flux)
    gradient = torch.zeros(flux)
    gradient[...] = solid.initial_grad
    stress, state = torch.zeros(flux), torch.zeros(solid.n_int, solid.n_elem, solid.n_state)
    outer, free = torch.zeros(solid.n_elem, *solid.n_flux), torch.tensor([], dtype=torch.int64)

    def assemble():
        solid.K = torch.empty(0)
        # increments from rest, step 1
        parts = solid.integrate_material(
            torch.zeros_like(u), gradient, stress, state, u.ravel(), outer, 1
        )
        return solid.assemble_matrix(parts[0], free), solid.assemble_rhs(parts[1])

    matrix, runs = assemble()[0], []
    for _ in range(request["repeats"]):
        start = time.process_time()
        assemble()
        runs.append(time.process_time() - start)
    product = matrix @ torch.tensor(arrays["way"].ravel())
    return {"compile_s": 0.0, "runs": runs}, {"product": np.asarray(product)}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
