"""Rods that may slip: vertices of their own, tied across and bonded along."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import Numbers, integers, real
from sorojax.fem.embedded import line
from sorojax.fem.embedded.rods import EmbeddedRod
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.material.hyperelastic import AbstractHyperelastic, small_strain_young_modulus
from sorojax.mesh.mesh import Mesh

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem

_TIE = 1e3  # stiffness across the rod over Young's modulus of the solid


class _Bond(NamedTuple):
    """Of each vertex: which of its group it is, weights of the nodes of the cell that holds
    it, how these change across the rod, the length that it stands for [m], and how far the
    bond has slipped [m]."""

    which: Float[Array, "vertices 3"]
    weights: Float[Array, "vertices cell_nodes"]
    directors: Float[Array, "vertices cell_nodes"]
    length: Float[Array, " vertices"]
    slipped: Float[Array, " vertices"]


class _Data(NamedTuple):
    bond: _Bond
    stretch: line.Stretch
    turn: line.Turn | None


class BondedRod(AbstractLoad):
    """A rod that slips in the solid where the bond is overcome: `bonded_rod(mesh, rod, ...)`.

    The vertices of `rod`, which says how stiff it is, are nodes of their own, `nodes`; forces
    and supports may act on them. `value` [-] is the share by which it is shorter than at rest.
    A vertex is tied across the rod to its point of the solid by `tie_stiffness` [N/m^2], force
    per length over distance. Along the rod the bond carries `bond_stiffness` [N/m^2] times the
    slip up to `bond_strength` [N/m] and slides at that force: it is elastic, then perfectly
    plastic. `slipped` [m] is what it has slid.

    Slip has a memory: `simulate` keeps it, and `update_friction(problem, u)` lets the next
    `solve` know of an equilibrium. A tie holds a vertex on the tangent through its point, so
    slip has to be small against the radius of curvature of the rod.
    """

    nodes: Int[Array, " vertices"] = eqx.field(converter=integers)
    rod: EmbeddedRod
    tie_stiffness: Float[Array, ""] = eqx.field(converter=real)
    bond_stiffness: Float[Array, ""] = eqx.field(converter=real)
    bond_strength: Float[Array, ""] = eqx.field(converter=real)
    slipped: Float[Array, " vertices"] = eqx.field(converter=real)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="rod")
    stiff_in_positions = True

    def curved_part(self, problem):
        data = self._data(problem.mesh.points)

        def energy(x, data):
            ends, director = self.chain(x, data)
            rod = line.stretch_energy(data.stretch, ends, self.value, self.rod.tension_only)
            if data.turn is not None:
                rod = rod + line.turn_energy(data.turn, ends, director)
            return rod + self._tie(ends, data.bond.weights @ x[3:], data.bond)

        return CurvedPart(self._groups(jnp), energy, data)

    def chain(self, x, data: _Data):
        """Vertices of a group [m] with its nodes at `x` [m], and the solid's director [-]."""
        return x[:3], data.bond.directors @ x[3:]

    def on_solid(self, problem, x) -> Float[Array, "1 points dim"]:
        """Force of each vertex on the solid with the nodes at `x` [m]."""
        bond = self._data(problem.mesh.points).bond
        pull = jax.vmap(jax.grad(self._tie, argnums=1))
        ends = x[self.nodes][self._near(np)]
        return -pull(ends, self.rod.vertices(x)[0], bond)[None]

    def _tie(self, ends, at: Float[Array, " dim"], bond: _Bond) -> Float[Array, ""]:
        """Energy of the tie of a vertex to its point `at` [m] of the solid."""
        gap = bond.which @ ends - at
        slip = jnp.sum(gap * self._along(ends))
        across = self.tie_stiffness / 2 * (jnp.sum(gap**2) - slip**2)
        return bond.length * (across + self._bond_energy(slip - bond.slipped))

    @staticmethod
    def _along(ends):
        chord = ends[2] - ends[0]
        return chord / line.norm(chord)

    def _bond_energy(self, stretch):
        """Energy per length [J/m] of a bond `stretch` [m] from where it has no force."""
        limit = self.bond_strength / self.bond_stiffness
        size = jnp.abs(stretch)
        sliding = self.bond_strength * (size - limit / 2)
        return jnp.where(size <= limit, self.bond_stiffness / 2 * stretch**2, sliding)

    def slips(self, problem: "Problem", u) -> Float[Array, " vertices"]:
        """How far each vertex is from its point along the rod [m]."""
        x = problem.mesh.points + u
        ends, solid = x[self.nodes], self.rod.vertices(x)[0]
        gap = ends - solid
        return jax.vmap(lambda gap, near: jnp.sum(gap * self._along(near)))(
            gap, ends[self._near(jnp)]
        )

    def remembered(self, problem, u):
        """The load that knows of the equilibrium `u` [m]: the bond has slid to its limit."""
        slip, limit = self.slips(problem, u), self.bond_strength / self.bond_stiffness
        stretch = jnp.clip(slip - self.slipped, -limit, limit)
        return dataclasses.replace(self, slipped=slip - stretch)

    def begun(self, problem, step):
        return self.remembered(problem, step.u)

    def couples(self):
        return self._groups(np)

    def lumped_mass(self, problem):
        mass = self.rod.mass_per_length
        if mass is None:
            raise ValueError(
                f"fem.simulate: BondedRod '{self.name}' needs a mass of its own, as its "
                "vertices move by themselves. Give `density` to fem.embedded_rod."
            )
        length = self._data(problem.mesh.points).bond.length
        zero = jnp.zeros(problem.mesh.num_nodes, length.dtype)
        return zero.at[self.nodes].add(length * jnp.broadcast_to(mass, (1,)))

    def _near(self, xp):
        """The three vertices in a row that each vertex is judged with."""
        count = self.nodes.shape[0]
        first = np.clip(np.arange(count) - 1, 0, count - 3)
        return xp.asarray(first[:, None] + np.arange(3))

    def _groups(self, xp):
        own = xp.asarray(self.nodes)[self._near(xp)]
        return xp.concatenate([own, xp.asarray(self.rod.route.nodes)], axis=1)

    def _data(self, points) -> _Data:
        count, near = self.nodes.shape[0], self._near(np)
        ends = points[self.nodes]
        rest = line.norm(ends[1:] - ends[:-1])
        inner = np.zeros(count)
        inner[1:-1] = 1.0
        which = np.eye(3)[np.arange(count) - near[:, 0]]
        shares = line.segment_shares(count, 3, (False, False))[near[:, 0]] * inner[:, None]
        spread = jnp.concatenate([jnp.zeros_like(rest[:1]), rest, jnp.zeros_like(rest[:1])])
        rod = self.rod
        directors = rod.route.weights if rod.directors is None else rod.directors
        bond = _Bond(
            jnp.asarray(which, rest.dtype),
            rod.route.weights,
            directors,
            (spread[1:] + spread[:-1]) / 2,
            self.slipped,
        )
        pairs = rest[near[:, :2]]
        axial = jnp.broadcast_to(rod.axial_stiffness, (count,))
        stretch = line.Stretch(pairs, jnp.asarray(shares, rest.dtype), axial)
        if rod.bending_stiffness is None:
            return _Data(bond, stretch, None)
        # vertices at the ends do not turn: their groups are those of the next ones
        span, share = (row[0][near[:, 0]] for row in line.spans(rest[None], (False, False)))
        bending = jnp.broadcast_to(rod.bending_stiffness, (count,)) * inner
        across = jnp.einsum("pa,pai->pi", directors, points[rod.route.nodes])
        at_rest = jax.vmap(line.turning)(ends[near], across)
        return _Data(bond, stretch, line.Turn(bending, span, share, at_rest))

    def check(self, where, mesh, kinematics):
        self.rod.check(where, mesh, kinematics)
        for name, unit in (
            ("tie_stiffness", "N/m^2"), ("bond_stiffness", "N/m^2"), ("bond_strength", "N/m"),
        ):  # fmt: skip
            do = "For a rod that does not slip take fem.embedded_rod."
            _check.positive("fem.problem", f"{where} {name}", getattr(self, name), unit, do)


def bonded_rod(
    mesh: Mesh,
    rod: EmbeddedRod,
    *,
    bond_strength: Numbers,
    bond_stiffness: Numbers | None = None,
    tie_stiffness: Numbers | None = None,
    material: AbstractHyperelastic | None = None,
) -> tuple[Mesh, BondedRod]:
    """The mesh with the vertices of `rod` as nodes of their own, and the rod that may slip.

    The bond is elastic up to `bond_strength` and then slides at that force, whatever pressure
    the solid has on the rod: for friction under a known pressure p on a round rod the
    strength is the coefficient times p times the circumference.

    Args:
        mesh: That `rod` was made on.
        rod: One rod, `embedded_rod(mesh, points, ...)`, not clamped: supports may hold its
            nodes. For motions it needs a `density`.
        bond_strength: Largest force along the rod per length [N/m].
        bond_stiffness: That force over the slip, before it is reached [N/m^2]; that of the tie
            when omitted.
        tie_stiffness: Force across the rod per length over the distance [N/m^2]. By default
            10^3 times Young's modulus of `material`, which yields by about 10^-3 of what the
            solid itself does.
        material: The solid, for the default.

    Returns:
        The mesh, with the node set `rod.name` of the vertices in their order, and the load.

    Raises:
        ValueError: If there is more than one rod, or it is clamped; or no stiffness is known.

    Example:
        >>> block = mesh.box([0, 0, 0], [60 * mm, 10 * mm, 10 * mm], divisions=(12, 2, 2))
        >>> line = [[5 * mm, 5 * mm, 5 * mm], [60 * mm, 5 * mm, 5 * mm]]
        >>> wire = fem.embedded_rod(block, line, axial_stiffness=500.0, name="wire")
        >>> both, wire = fem.bonded_rod(block, wire, bond_strength=20.0, tie_stiffness=1e8)
        >>> both.num_nodes - block.num_nodes, both.node_sets["wire"].shape
        (12, (12,))
    """
    if rod.rods != 1 or any(rod.clamped):
        raise ValueError(
            f"fem.bonded_rod: got {rod.rods} rods with clamped={rod.clamped}, need one rod "
            "that is not clamped. Call it for each, and hold nodes by fem.Fixed."
        )
    if tie_stiffness is None:
        if material is None:
            raise ValueError(
                "fem.bonded_rod: got neither `tie_stiffness` nor `material`, need one. Give "
                "the material of the solid."
            )
        tie_stiffness = _TIE * jnp.mean(small_strain_young_modulus(material))
    bond_stiffness = tie_stiffness if bond_stiffness is None else bond_stiffness
    ends = rod.vertices(mesh.points)[0]
    nodes = mesh.num_nodes + np.arange(len(ends))
    sets = mesh.node_sets | {rod.name: integers(nodes)}
    wider = dataclasses.replace(
        mesh, points=jnp.concatenate([mesh.points, ends]), node_sets=sets
    )
    none = jnp.zeros(len(ends), ends.dtype)
    numbers = tie_stiffness, bond_stiffness, bond_strength
    return wider, BondedRod(nodes, rod, *numbers, none, rod.value, rod.name)
