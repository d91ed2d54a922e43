"""Assembly in scikit-fem: `python -I scikit_fem.py FOLDER`."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import skfem
from scipy.spatial import cKDTree
from skfem.helpers import ddot, det, grad, inv, transpose

#: Mesh, element and order of its quadrature, as `benchmarks.blocks` has them.
KINDS = {
    "Tri3": (skfem.MeshTri, skfem.ElementTriP1, 1),
    "Quad4": (skfem.MeshQuad, skfem.ElementQuad1, 2),
    "Tet10": (skfem.MeshTet, skfem.ElementTetP2, 2),
}
CORNERS = {"Tri3": 3, "Quad4": 4, "Tet10": 4}


def forms(mu, bulk):
    """Residual and tangent of mu/2 (I1 J^(-2/3) - 3) + bulk/2 (J - 1)^2, by hand."""

    def state(w):
        G = w["u"].grad
        dim = G.shape[0]
        F = G + np.eye(dim)[:, :, None, None]
        J, first = det(F), ddot(F, F) + (3 - dim)
        return F, J, transpose(inv(F)), first, mu * J ** (-2 / 3), bulk * (J - 1) * J

    @skfem.LinearForm
    def residual(v, w):
        F, _, H, first, shear, pressure = state(w)
        return ddot(shear * (F - first / 3 * H) + pressure * H, grad(v))

    @skfem.BilinearForm
    def tangent(du, v, w):
        F, J, H, first, shear, pressure = state(w)
        D = grad(du)
        HD, FD = ddot(H, D), ddot(F, D)
        both = 2 / 9 * shear * first + bulk * (2 * J - 1) * J
        turned = np.einsum("il...,kl...,kj...->ij...", H, D, H)
        stress = shear * D - 2 / 3 * shear * (F * HD + H * FD) + both * H * HD
        return ddot(stress + (shear * first / 3 - pressure) * turned, grad(v))

    return residual, tangent


def unknowns(basis, points):
    """Number of each of its unknowns in the order node by node of the request."""
    dim = points.shape[1]
    _, node = cKDTree(points).query(basis.doflocs.T)
    component = np.empty(basis.N, int)
    for group in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
        for row, dofs in enumerate(group):
            component[dofs] = row % dim
    return dim * node + component


def assembly(request, arrays):
    """CPU seconds of residual and tangent at the displacement `u`."""
    kind, element, order = KINDS[request["element"]]
    points, corners = arrays["points"], arrays["cells"][:, : CORNERS[request["element"]]]
    used, cells = np.unique(corners, return_inverse=True)
    grid = kind(points[used].T, cells.reshape(corners.shape).T)
    basis = skfem.Basis(grid, skfem.ElementVector(element()), intorder=order)
    places = unknowns(basis, points)
    residual, tangent = forms(request["mu"], request["bulk"])
    u, runs = arrays["u"].ravel()[places], []
    for _ in range(request["repeats"]):
        start = time.process_time()
        at = basis.interpolate(u)
        residual.assemble(basis, u=at)
        matrix = tangent.assemble(basis, u=at)
        runs.append(time.process_time() - start)
    product = np.empty(u.size)
    product[places] = matrix @ arrays["way"].ravel()[places]
    return {"compile_s": 0.0, "runs": runs}, {"product": product}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
