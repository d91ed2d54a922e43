"""Torsion and shear of a section of any shape: Saint-Venant's problems on its mesh.

The warping function w is harmonic with slope (z, -y).n on the boundary, whatever holes
there are, and J = Ip - integral of (z, -y).grad w is the least value of an energy: its
error is the square of that of w. Shear needs one more harmonic function per direction.

Reference:
    Timoshenko, Goodier, Theory of Elasticity, 1970, section 104, for torsion.
    Cowper, The shear coefficient in Timoshenko's beam theory, J. Appl. Mech. 33, 1966,
    equation 30, for shear, exact where y and z are principal axes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.math.compiled import jit_public
from sorojax.math.linalg import sparse
from sorojax.math.quadrature import gauss_legendre
from sorojax.mesh.elements.base import shape_functions, shape_gradients
from sorojax.mesh.elements.simplex import Tri3, Tri6
from sorojax.mesh.mesh import Mesh

_RULE = 5  # Gauss points per side of the collapsed square: degree 8


class PlaneConstants(NamedTuple):
    """Constants of a section, about the centroid; y is the first axis.

    Attributes:
        area: [m^2].
        centroid: In the axes of the mesh [m].
        moments: Integral of r r' [m^4].
        torsion_constant: [m^4].
        warping: Integrals of y (z) times Cowper's harmonic function at Poisson's ratio 0,
            its change per ratio, and y^2 z^2, one column per direction of shear [m^6].
    """

    area: Float[Array, ""]
    centroid: Float[Array, "2"]
    moments: Float[Array, "2 2"]
    torsion_constant: Float[Array, ""]
    warping: Float[Array, "3 2"]


def plane_constants(mesh: Mesh, *, principal: bool = False) -> PlaneConstants:
    """Section constants of a plane mesh, differentiable in its points.

    Args:
        mesh: Triangles, `Tri6` for curved sides and accuracy; holes are allowed.
        principal: Use principal axes, the first with the larger moment.

    Raises:
        ValueError: If the cells are no triangles or the topology is traced.
    """
    if not isinstance(mesh.element, Tri3 | Tri6):
        raise ValueError(
            f"plane_constants: got {mesh.element.name} cells, need triangles. Mesh the "
            "section with triangulate(shape, size=..., order=2)."
        )
    if is_traced(mesh.cells):
        raise ValueError("plane_constants: the topology is traced. Mesh outside jit.")
    _check.float64("plane_constants", mesh.points)
    with jax.ensure_compile_time_eval():
        system = sparse.from_cells(mesh.num_nodes, np.asarray(mesh.cells))
    return _constants(mesh, system, principal)


def principal_angle(moments: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Angle [rad] from the first axis to the principal one with the larger moment."""
    return jnp.arctan2(2 * moments[0, 1], moments[0, 0] - moments[1, 1]) / 2


@jit_public
def shear_factors(
    constants: PlaneConstants, poisson_ratio
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cowper's shear factors along y and along z at a Poisson's ratio [-]."""
    nu, own = real(poisson_ratio), jnp.diagonal(constants.moments)
    plain, change, fourth = constants.warping
    bent = constants.area / own * (plain + nu * change + fourth)
    found = 2 * (1 + nu) * own / (nu / 2 * (own[::-1] - own) - bent)
    return found[0], found[1]


@once
def _constants(mesh: Mesh, system: sparse.SparseSymmetric, principal: bool) -> PlaneConstants:
    middle = _moments(mesh, mesh.points)[1]
    points = mesh.points - middle[None]
    moments = _moments(mesh, points)[2]
    if principal:
        angle = principal_angle(moments)
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        points = points @ jnp.stack([cosine, -sine, sine, cosine]).reshape(2, 2)
    area, _, moments = _moments(mesh, points)
    values, loads, fourth = _matrices(mesh, system, points)
    solve = jax.vmap(lambda load: sparse.solve(system, values, load))
    answers = solve(loads[:5].at[:, 0].set(0.0))
    warp, answers = answers[0], answers[1:]
    shares = jnp.stack([answers[k] @ loads[5 + k // 2] for k in range(4)]).reshape(2, 2)
    return PlaneConstants(
        area,
        middle,
        moments,
        jnp.trace(moments) - loads[0] @ warp,
        jnp.concatenate([shares.T, jnp.stack([fourth, fourth])[None]]),
    )


def _rule(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, values and slopes at the points of a square collapsed on the triangle."""
    x, w = gauss_legendre(_RULE)
    first, second = (g.ravel() for g in np.meshgrid(x, x, indexing="ij"))
    at = np.stack([first, second * (1 - first)], axis=1)
    weights = (w[:, None] * w[None] * (1 - x)[:, None]).ravel()
    return weights, shape_functions(mesh.element, at), shape_gradients(mesh.element, at)


def _fields(mesh: Mesh, points: Float[Array, "nodes 2"]):
    """Areas, places and slopes of the shape functions at all points of all cells."""
    weights, values, slopes = (jnp.asarray(table) for table in _rule(mesh))
    x = points[mesh.cells]
    jac = jnp.einsum("qad,cai->cqid", slopes, x)
    det = jac[..., 0, 0] * jac[..., 1, 1] - jac[..., 0, 1] * jac[..., 1, 0]
    turned = jnp.stack([jac[..., 1, 1], -jac[..., 0, 1], -jac[..., 1, 0], jac[..., 0, 0]], -1)
    back = (turned / det[..., None]).reshape(jac.shape)
    grads = jnp.einsum("qad,cqdi->cqai", slopes, back)
    return det * weights[None], jnp.einsum("qa,cai->cqi", values, x), values, grads


def _moments(mesh: Mesh, points: Float[Array, "nodes 2"]):
    areas, place, _, _ = _fields(mesh, points)
    area = jnp.sum(areas)
    first = jnp.einsum("cq,cqi->i", areas, place)
    return area, first / area, jnp.einsum("cq,cqi,cqj->ij", areas, place, place)


def _matrices(mesh: Mesh, system: sparse.SparseSymmetric, points: Float[Array, "nodes 2"]):
    """Stiffness with one node held; loads of torsion, of shear along y (nu^0, nu^1) and
    along z, and of y and z; and the integral of y^2 z^2."""
    areas, place, values, grads = _fields(mesh, points)
    cells = jnp.einsum("cq,cqai,cqbi->cab", areas, grads, grads)
    held = jnp.zeros(mesh.num_nodes, bool).at[0].set(True)
    stiffness = sparse.fix(system, sparse.assemble(system, cells), held)
    y, z = place[..., 0], place[..., 1]
    half = (y**2 - z**2) / 2
    flux = jnp.stack(
        [
            jnp.stack([z, -y], axis=-1),
            -jnp.stack([z**2, 2 * y * z], axis=-1),
            -jnp.stack([half, y * z], axis=-1),
            -jnp.stack([2 * y * z, y**2], axis=-1),
            -jnp.stack([y * z, -half], axis=-1),
        ]
    )
    source = jnp.stack([jnp.zeros_like(y), -2 * y, -2 * y, -2 * z, -2 * z, y, z])
    loads = jnp.einsum("cq,kcq,qa->kca", areas, source, values)
    loads = loads.at[:5].add(jnp.einsum("cq,kcqi,cqai->kca", areas, flux, grads))
    total = jnp.zeros((7, mesh.num_nodes), loads.dtype).at[:, mesh.cells].add(loads)
    return stiffness, total, jnp.sum(areas * (y * z) ** 2)
