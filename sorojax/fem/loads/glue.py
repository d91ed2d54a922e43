"""Two surfaces glued together whose facets need not match."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import Numbers, integers, optional_real, real
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.loads.segments import functions_at, pieces
from sorojax.material.hyperelastic import small_strain_young_modulus
from sorojax.mesh.elements.base import facet_corners
from sorojax.mesh.measure import locate
from sorojax.mesh.mesh import Mesh, facet_table

_STIFFNESS = 1e4  # times that of the material around


class Glue(AbstractLoad):
    """A thin stiff layer between two surfaces: `glue(mesh, facets, others)` makes it.

    At quadrature points of `sides`, facets of the first surface, the material of the `cells`
    of the other one that face them is continued to the point; the gap between the two is zero
    at rest and stays so in every rigid motion. Its means, weighted by the linear functions of
    the corners, are held by `stiffness` [N/m^3]. `value` has no meaning.

    Attributes:
        values, slopes: Shape functions of the facet of each point there, and their slopes by
            the facet's own coordinates [-].
        hats: Linear functions of its corners there [-].
        weights: Of the points; those of a whole facet add up to the size of the reference one.
        groups: Nodes that the mean gap at each corner depends on.
        rows: Row of `groups` of each corner of the facet of a point.
        places: Where the nodes of facet and cell are in that row.
    """

    sides: Int[Array, "quad facet_nodes"] = eqx.field(converter=integers)
    cells: Int[Array, " quad"] = eqx.field(converter=integers)
    values: Float[Array, "quad facet_nodes"]
    slopes: Float[Array, "quad facet_nodes dim_minus_1"]
    hats: Float[Array, "quad corners"]
    weights: Float[Array, " quad"]
    groups: Int[Array, "corners group_nodes"] = eqx.field(converter=integers)
    rows: Int[Array, "quad corners"] = eqx.field(converter=integers)
    places: Int[Array, "quad corners nodes"] = eqx.field(converter=integers)
    stiffness: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="glue")

    def _energy(self, x, data):
        weights, area = data
        assert self.stiffness is not None  # `problem` fills it in
        return 0.5 * self.stiffness * area * jnp.sum((weights @ x) ** 2)

    def potential(self, problem, u):
        # of displacements: the gap at rest is zero, that of positions is rounding
        data = self._means(problem)
        return jnp.sum(jax.vmap(self._energy)(u[self.groups], data))

    def curved_part(self, problem):
        return CurvedPart(self.groups, self._energy, self._means(problem))

    def _means(self, problem):
        """Weights of the nodes in the mean gap at every corner, and the area of each [m^2]."""
        X = problem.mesh.points
        corners = X[self.sides]
        at = jnp.einsum("qa,qai->qi", self.values, corners)
        slope = jnp.einsum("qad,qai->qid", self.slopes, corners)
        if X.shape[1] == 2:
            size = jnp.sqrt(jnp.sum(slope[:, :, 0] ** 2, axis=1))
        else:
            size = jnp.sqrt(jnp.sum(jnp.cross(slope[:, :, 0], slope[:, :, 1]) ** 2, axis=1))
        size = self.weights * size * problem.kinematics.depth(tuple(at.T))
        other = locate(problem.mesh, at, self.cells).weights
        share = size[:, None] * self.hats
        area = jnp.zeros(self.groups.shape[0], X.dtype).at[self.rows].add(share)
        entries = jnp.concatenate([self.values, -other], axis=1)
        gap = jnp.zeros(self.groups.shape, X.dtype)
        gap = gap.at[self.rows[:, :, None], self.places].add(
            share[:, :, None] * entries[:, None, :]
        )
        return gap / area[:, None], area

    def couples(self):
        return np.asarray(self.groups)

    def completed(self, mesh, material, kinematics):
        if self.stiffness is not None:
            return self
        modulus = jnp.max(small_strain_young_modulus(material))
        length = jnp.mean(jnp.ptp(mesh.points[mesh.cells], axis=1))
        return eqx.tree_at(
            lambda load: load.stiffness,
            self,
            _STIFFNESS * modulus / length,
            is_leaf=lambda leaf: leaf is None,
        )

    def check(self, where, mesh, kinematics):
        if self.stiffness is not None:
            _check.positive(
                "fem.problem",
                f"{where} stiffness",
                self.stiffness,
                "N/m^3",
                "Leave it out for 10^4 times that of a cell.",
            )


def glue(
    mesh: Mesh,
    facets: Int[Array | np.ndarray, "facets facet_nodes"],
    others: Int[Array | np.ndarray, "others facet_nodes"],
    *,
    stiffness: Numbers | None = None,
    name: str = "glue",
) -> Glue:
    """A term that holds two surfaces of one mesh together, whose facets need not match.

    The gap u_1 - u_2 between them is held to zero in its means with the linear functions of
    the corners of `facets`, integrated over the pieces on which both sides are smooth (mortar
    method): a constant stress passes from one side to the other without error, and the order
    of the elements is kept. A stiff layer takes the place of multipliers, so the tangent stays
    positive and the forces are in balance, moments included, at every displacement.

    Args:
        mesh: The mesh; `mesh.merge(a=..., b=...)` puts two bodies into one. Arrays of material
            constants go body after body.
        facets: Of the first surface; the softer, or finer, one of the two.
        others: Of the second surface, facing the first. Parts of either that face nothing stay
            free.
        stiffness: Of the layer [N/m^3], by default 10^4 times Young's modulus over the size of
            a cell: beside the strain of one layer of cells it gives way by 10^-4 of it.
        name: Name of the term.

    Returns:
        The term, for `loads` of `fem.problem`. Which facets face each other is found here,
        once; everything else follows the nodes and has their derivative.

    Raises:
        ValueError: If the surfaces do not face each other anywhere, or `others` are not facets
            of cells; if the mesh is traced.

    Example:
        >>> both = mesh.merge(
        ...     a=mesh.rectangle([0, 0], [20 * mm, 10 * mm], divisions=(2, 2)),
        ...     b=mesh.rectangle([20 * mm, 0], [40 * mm, 10 * mm], divisions=(3, 3)))
        >>> seam = fem.glue(both, both.facet_sets["b.left"], both.facet_sets["a.right"])
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3)
        >>> problem = fem.problem(
        ...     both, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(both.node_sets["a.left"]),),
        ...     loads=(seam, fem.Force(both.node_sets["b.right"], [0.1, 0])))
        >>> pulled = fem.solve(problem).displacement[both.node_sets["b.right"], 0]
        >>> print(f"{float(pulled.mean()) / mm:.3f} mm")
        0.036 mm

    References:
        Puso and Laursen, A mortar segment-to-segment contact method for large deformation
        solid mechanics, CMAME 193, 2004. Wohlmuth, A mortar finite element method using dual
        spaces for the Lagrange multiplier, SIAM J. Numer. Anal. 38, 2000.
    """
    if is_traced((mesh.points, mesh.cells)):
        raise ValueError(
            "fem.glue: the mesh is traced, need concrete points to see which facets face each "
            "other. Make the term outside, and replace the points of the problem in the trace."
        )
    sides, faced = np.asarray(facets, int), np.asarray(others, int)
    owners = _owners(mesh, faced)
    X = np.asarray(mesh.points, float)
    found = pieces(X, mesh.element, sides, faced)
    if not len(found.facet):
        raise ValueError(
            f"fem.glue: {len(sides)} and {len(faced)} facets do not face each other anywhere. "
            "Place the bodies so that they touch, and take facets of both outsides."
        )
    cells = owners[found.other]
    tables = functions_at(mesh.element, found.at)
    own = sides[found.facet]
    nodes = np.concatenate([own, np.asarray(mesh.cells)[cells]], axis=1)
    groups, rows, places = _groups(own[:, : facet_corners(mesh.element)], nodes)
    arrays = (jnp.asarray(x) for x in (*tables, found.weights))
    return Glue(own, cells, *arrays, groups, rows, places, stiffness, name=name)


def _owners(mesh: Mesh, facets: np.ndarray) -> Int[np.ndarray, " facets"]:
    """The cell that each facet bounds."""
    count = facet_corners(mesh.element)
    listed = np.sort(facet_table(mesh)[0][:, :count], axis=1)
    by_corners = {tuple(row): k % mesh.num_cells for k, row in enumerate(listed)}
    try:
        return np.array([by_corners[tuple(row)] for row in np.sort(facets[:, :count], axis=1)])
    except KeyError as error:
        raise ValueError(
            f"fem.glue: {error.args[0]} are corners of no facet of the mesh. Take facets from "
            "it: mesh.facet_sets or mesh.facets_on."
        ) from None


def _groups(corners: np.ndarray, nodes: np.ndarray):
    """For every corner the nodes that its mean gap depends on, filled up with the first of
    them; the row of each corner of a point, and where its nodes are in that row."""
    names, rows = np.unique(corners, return_inverse=True)
    rows = rows.reshape(corners.shape)
    most = nodes.max() + 1
    keys = rows[:, :, None] * most + nodes[:, None, :]
    pairs, number = np.unique(keys, return_inverse=True)
    row, node = np.divmod(pairs, most)
    first = np.searchsorted(row, np.arange(len(names)))
    place = np.arange(len(pairs)) - first[row]
    groups = np.repeat(node[first][:, None], place.max() + 1, axis=1)
    groups[row, place] = node
    return groups, rows, place[number.reshape(keys.shape)]
