"""Fibres, backbones and stiff tendons that are bonded to the solid around them.

The vertices of the rod are points of the solid: `x(X_j) = sum N_a(X_j) x_a` in the cell that
holds `X_j`. So the tie is exact, needs neither unknowns nor a penalty, and the rod is a
potential of the nodes of the cells that it crosses: a segment couples the nodes of two cells,
a bending stiffness those of three. Strain coordinates, or splines with nodes of their own,
would need multipliers or a penalty for the same tie, and a helix of many turns a dense block.

Vertices should be as far apart as cells are wide: between them a displacement that has kinks
at the faces of cells is smoothed. Nearer ones would count these kinks as curvature and make
the rod too stiff, and further ones lose the shape. `benchmarks/cases/fem_embedded.py` has a
fibre of a fifth of the width of a block, 100 times as stiff, straight and wavy: with cells of
two and a half times its thickness the energy is that of a mesh that follows it to 0.15 %, with
13 times fewer unknowns; with cells of 1.7 times it to 0.44 %.

The section of the rod turns with the solid at the centreline, which is what an initially
curved rod is bent against. The bond passes on forces, no torque about the axis: the twist of
a solid by a couple on a line is not bounded as the mesh is refined. For the same reason,
though weaker (a logarithm), a line of force sinks in without bound where cells become much
smaller than the thickness of the rod. The model is meant for cells that are not much smaller
than the rod is thick; mesh a thicker rod instead.

Reference:
    Steinbrecher, Mayr, Grill, Kremheller, Meier, Popp, "A mortar-type finite element approach
    for embedding 1D beams into 3D solid volumes", Comput. Mech. 66, 2020, for the same model
    tied by mortar, and for its limits.
"""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, optional_real, real
from sorojax.fem.embedded import line
from sorojax.fem.kinematics import Axisymmetric
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.loads.springs import Route
from sorojax.material.hyperelastic import AbstractHyperelastic, small_strain_young_modulus
from sorojax.mesh.measure import Locations, cells_at, locate
from sorojax.mesh.mesh import Mesh


class _Data(NamedTuple):
    """Of each group: weights of the nodes at its points, its segments, and its vertex."""

    weights: Float[Array, "groups points cell_nodes"]
    offsets: Float[Array, "groups points dim"]
    stretch: line.Stretch
    directors: Float[Array, "groups cell_nodes"] | None
    turn: line.Turn | None


class EmbeddedRod(AbstractLoad):
    """Rods bonded to the solid along their centrelines: `embedded_rod(mesh, points, ...)`.

    `axial_stiffness` EA [N] and `bending_stiffness` EI [N m^2] are one number or one per rod;
    without the latter a rod is a fibre. `value` [-] is the share by which its own length is
    shorter than in the reference configuration: an actuator, under
    `solve_path(problem, rod=values)`. With `tension_only` a fibre slackens instead of
    carrying compression. `mass_per_length` [kg/m] counts in `simulate`; weight does not act.
    `clamped` says at which ends, the first and the last, the direction of the rod is that of
    the reference configuration: in a wall that holds the solid, or across a plane of symmetry.
    Elsewhere the end of a rod carries no moment.

    `route` places the vertices of all `rods`, so many with as many vertices each, one after the
    other in the cells that hold them. `directors` [1/m] are the slopes of its weights across
    the rod, by which the section turns with the solid; None in the plane and for a fibre.
    """

    route: Route
    axial_stiffness: Float[Array, "*rods"] = eqx.field(converter=real)
    bending_stiffness: Float[Array, "*rods"] | None = eqx.field(
        converter=optional_real, default=None
    )
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="rod")
    mass_per_length: Float[Array, "*rods"] | None = eqx.field(
        converter=optional_real, default=None
    )
    directors: Float[Array, "points cell_nodes"] | None = None
    rods: int = eqx.field(static=True, default=1)
    tension_only: bool = eqx.field(static=True, default=False)
    clamped: line.Ends = eqx.field(static=True, default=(False, False))
    stiff_in_positions: ClassVar[bool] = True

    @property
    def _width(self) -> int:
        return 2 if self.bending_stiffness is None else 3

    def vertices(self, x: Float[Array, "nodes dim"]) -> Float[Array, "rods points dim"]:
        """Where the vertices are [m] with the nodes at `x` [m]."""
        at = Locations(self.route.nodes, self.route.weights)(x)
        return at.reshape(self.rods, -1, x.shape[1])

    def _energy(self, ends: Float[Array, "points dim"], director, data: _Data):
        """Energy [J] of a group with its vertices at `ends`."""
        energy = line.stretch_energy(data.stretch, ends, self.value, self.tension_only)
        if data.turn is None:
            return energy
        return energy + line.turn_energy(data.turn, ends, director)

    def curved_part(self, problem):
        def energy(x, data):
            return self._energy(*self.chain(x, data), data)

        return CurvedPart(self._groups(jnp), energy, self.data(problem.mesh.points))

    def chain(self, x, data: _Data):
        """Vertices of a group [m] with its nodes at `x` [m], and the solid's director [-]."""
        x = x.reshape(*data.weights.shape, -1)
        ends = jnp.einsum("pa,pai->pi", data.weights, x) + data.offsets
        return ends, None if data.directors is None else data.directors @ x[1]

    def on_solid(self, problem, x) -> Float[Array, "rods points dim"]:
        """Force of each vertex on the solid with the nodes at `x` [m]; without that of couples
        of an initially curved rod on the direction of the section."""
        part, beyond = self.curved_part(problem), self._beyond(problem.mesh.points)
        directors = jax.vmap(lambda *row: self.chain(*row)[1])(x[part.groups], part.data)

        def energy(ends):
            groups = _windows(self._padded(ends) + beyond, self._width)
            return jnp.sum(jax.vmap(self._energy)(groups, directors, part.data))

        return -jax.grad(energy)(self.vertices(x))

    def data(self, points: Float[Array, "nodes dim"]) -> _Data:
        """What the groups need, of the reference configuration."""
        width, offsets = self._width, self._beyond(points)
        ends = self._padded(self.vertices(points)) + offsets
        rest = line.norm(ends[:, 1:] - ends[:, :-1])
        shares = line.segment_shares(ends.shape[1], width, self.clamped)
        axial = jnp.broadcast_to(self.axial_stiffness, (self.rods,))
        stretch = line.Stretch(
            _windows(rest, width - 1),
            jnp.tile(jnp.asarray(shares, rest.dtype), (self.rods, 1)),
            jnp.repeat(axial, len(shares)),
        )
        weights = _windows(self._padded(self._by_rod(self.route.weights)), width)
        offsets = _windows(offsets, width)
        if self.bending_stiffness is None:
            return _Data(weights, offsets, stretch, None, None)
        span, share = line.spans(rest, self.clamped)
        bending = jnp.repeat(
            jnp.broadcast_to(self.bending_stiffness, (self.rods,)), span.shape[1]
        )
        at_rest = self._turnings(points, _windows(ends, 3))
        turn = line.Turn(bending, span.ravel(), share.ravel(), at_rest)
        directors = None if self.directors is None else self._middle(self.directors)
        return _Data(weights, offsets, stretch, directors, turn)

    def _turnings(self, points, ends) -> Float[Array, "groups turns"]:
        """How the vertices turn in the reference configuration."""
        if self.directors is None:
            return jax.vmap(lambda ends: line.turning(ends, ends[0]))(ends)
        across = jnp.einsum("pa,pai->pi", self.directors, points[self.route.nodes])
        return jax.vmap(line.turning)(ends, self._middle(across))

    def _beyond(self, points) -> Float[Array, "rods padded dim"]:
        """From the vertices to the groups' points [m]: beyond a clamped end there is one more,
        in the direction of the reference configuration."""
        ends = self.vertices(points)
        beyond = self._padded(jnp.zeros_like(ends))
        for end, next_one, held in zip((0, -1), (1, -2), self.clamped, strict=True):
            if held:
                beyond = beyond.at[:, end].set(ends[:, end] - ends[:, next_one])
        return beyond

    def _padded(self, rows: Any) -> Any:
        """`rows` of vertices, the first and the last once more where they are clamped."""
        xp = np if isinstance(rows, np.ndarray) else jnp
        held, (first, last) = self._width == 3, self.clamped
        before = [rows[:, :1]] if held and first else []
        after = [rows[:, -1:]] if held and last else []
        return xp.concatenate([*before, rows, *after], axis=1)

    def couples(self):
        return self._groups(np)

    def lumped_mass(self, problem):
        if self.mass_per_length is None:
            return None
        ends = self.vertices(problem.mesh.points)
        rest = line.norm(ends[:, 1:] - ends[:, :-1])
        none = jnp.zeros_like(rest[:, :1])
        own = jnp.concatenate([none, rest], axis=1) + jnp.concatenate([rest, none], axis=1)
        mass = (own / 2 * jnp.broadcast_to(self.mass_per_length, (self.rods,))[:, None]).ravel()
        share = self.route.weights**2  # positive, and the whole mass
        share = share / jnp.sum(share, axis=1, keepdims=True)
        zero = jnp.zeros(problem.mesh.num_nodes, mass.dtype)
        return zero.at[self.route.nodes].add(mass[:, None] * share)

    def _groups(self, xp):
        nodes = self._padded(self._by_rod(xp.asarray(self.route.nodes)))
        return _windows(nodes, self._width).reshape(-1, self._width * nodes.shape[2])

    def _by_rod(self, rows: Any) -> Any:
        return rows.reshape(self.rods, -1, *rows.shape[1:])

    def _middle(self, rows: Any) -> Any:
        """Of the vertices that turn."""
        inner = self._padded(self._by_rod(rows))[:, 1:-1]
        return inner.reshape(-1, *rows.shape[1:])

    def check(self, where, mesh, kinematics):
        if isinstance(kinematics, Axisymmetric):
            raise ValueError(
                f"fem.problem: {where} is a line in a body of revolution, where it would be a "
                "surface. Use a solid mesh."
            )
        numbers = (
            ("axial_stiffness", "N"), ("bending_stiffness", "N m^2"),
            ("mass_per_length", "kg/m"),
        )  # fmt: skip
        for name, unit in numbers:
            if (number := getattr(self, name)) is not None:
                do = "Leave it out for a rod without it."
                _check.positive("fem.problem", f"{where} {name}", number, unit, do)
                if number.shape not in ((), (self.rods,)):
                    raise ValueError(
                        f"fem.problem: {where} has {name} of shape {number.shape}, need () or "
                        f"({self.rods},): one for all rods or one each."
                    )


def _windows(rows: Any, width: int) -> Any:
    """Every `width` points in a row of each rod, (rods * groups, width, ...)."""
    count = rows.shape[1] - width + 1
    xp = np if isinstance(rows, np.ndarray) else jnp
    found = xp.stack([rows[:, k : k + count] for k in range(width)], axis=2)
    return found.reshape(-1, width, *rows.shape[2:])


def embedded_rod(
    mesh: Mesh,
    points: Numbers,
    *,
    axial_stiffness: Numbers | None = None,
    bending_stiffness: Numbers | None = None,
    radius: Numbers | None = None,
    young_modulus: Numbers | None = None,
    matrix: AbstractHyperelastic | None = None,
    density: Numbers | None = None,
    spacing: float | None = None,
    clamped: tuple[bool, bool] = (False, False),
    tension_only: bool = False,
    value: Numbers = 0.0,
    name: str = "rod",
) -> EmbeddedRod:
    """Rods along polylines through a solid whose mesh does not follow them, for
    `fem.problem(..., loads=(rod,))`.

    Give the stiffnesses, or `radius` and `young_modulus` of a round rod: EA = E pi r^2 and
    EI = E pi r^4 / 4. The rod lies in cells that are full of the solid; `matrix` is the
    material whose Young's modulus is taken off for that.

    Differentiable in all numbers, in the points and in the mesh. Which cell holds a vertex is
    chosen here; a derivative by the points keeps the cells.

    Args:
        mesh: Triangles, quadrilaterals or solid cells. In the plane stiffnesses are those of
            all rods in the depth together.
        points: Corners of one polyline [m], (points, dim), or of several with as many corners
            each, (rods, points, dim).
        axial_stiffness: EA [N].
        bending_stiffness: EI [N m^2], the same in all directions; a fibre has none.
        radius: Of a round section [m].
        young_modulus: Of the rod [Pa].
        matrix: Material of the solid that the rod takes the place of.
        density: Of a round rod [kg/m^3], for `simulate`.
        spacing: Distance of the vertices along the rod [m], by default the mean width of the
            cells along it.
        clamped: Whether the direction of the rod is held at its first and its last point.
        tension_only: Whether a fibre slackens under compression.
        value: Share by which the rod is shorter than its place in the solid [-].
        name: Of the term.

    Returns:
        The term, all rods in one.

    Raises:
        ValueError: If a vertex lies outside the mesh, or it is not clear how stiff the rod is.

    Example:
        >>> block = mesh.box([0, 0, 0], [60 * mm, 10 * mm, 10 * mm], divisions=(12, 2, 2))
        >>> wire = fem.embedded_rod(block, [[0, 5 * mm, 5 * mm], [60 * mm, 5 * mm, 5 * mm]],
        ...                         radius=0.3 * mm, young_modulus=2e9)
        >>> print(f"{float(wire.axial_stiffness):.0f} N, {len(wire.route.nodes)} vertices")
        565 N, 13 vertices
    """
    points = _polylines(mesh, points)
    given = axial_stiffness, bending_stiffness, radius, young_modulus
    axial, bending = _stiffnesses(*given, matrix)
    width = _width_of_cells(mesh, points) if spacing is None else spacing
    length = np.asarray(jax.lax.stop_gradient(line.norm(points[:, 1:] - points[:, :-1])))
    count = max(3, 1 + round(float(length.sum(axis=1).max() / width)))
    ends = line.resampled(points, count).reshape(-1, mesh.element.dim)
    cells = jnp.asarray(cells_at(mesh, ends))
    nodes, weights, _ = locate(mesh, ends, cells)
    mass = None
    if density is not None:
        if radius is None:
            raise ValueError("fem.embedded_rod: got a density without a radius, need both.")
        mass = real(density) * jnp.pi * real(radius) ** 2
    return EmbeddedRod(
        Route(nodes, weights),
        axial,
        bending,
        value,
        name,
        mass,
        None if bending is None else _directors(mesh, ends, cells, len(points)),
        len(points),
        tension_only,
        clamped,
    )


def _polylines(mesh: Mesh, points) -> Float[Array, "rods points dim"]:
    points = real(points)
    points = points[None] if points.ndim == 2 else points
    if points.ndim != 3 or points.shape[2] != mesh.element.dim or points.shape[1] < 2:
        raise ValueError(
            f"fem.embedded_rod: `points` has shape {points.shape}, need (points, "
            f"{mesh.element.dim}) or (rods, points, {mesh.element.dim}) with two points or "
            "more. Give one row per corner."
        )
    _check.finite("fem.embedded_rod", "points", points, "Give points in metres.")
    return points


def _stiffnesses(axial, bending, radius, young, matrix):
    if (axial is None) == (radius is None) or (radius is None) != (young is None):
        raise ValueError(
            "fem.embedded_rod: got no stiffness, or two. Give axial_stiffness, or radius and "
            "young_modulus."
        )
    if radius is None or young is None:
        if matrix is not None:
            raise ValueError(
                "fem.embedded_rod: got `matrix` without a section, need radius and "
                "young_modulus. Or take its share off axial_stiffness yourself."
            )
        return axial, bending
    radius, young = real(radius), real(young)
    for name, number, unit in (("radius", radius, "m"), ("young_modulus", young, "Pa")):
        _check.positive("fem.embedded_rod", name, number, unit, "SI units: 0.5 * mm, 2 * GPa.")
    if matrix is not None:
        young = young - jnp.mean(small_strain_young_modulus(matrix))
        do = "A rod softer than the solid is a hole: mesh it."
        _check.positive("fem.embedded_rod", "young_modulus - matrix", young, "Pa", do)
    return young * jnp.pi * radius**2, young * jnp.pi * radius**4 / 4


def _width_of_cells(mesh: Mesh, points: Float[Array, "rods points dim"]) -> float:
    """Mean extent of the cells along polylines [m]."""
    count = 64
    fixed = jax.lax.stop_gradient(points)
    ends = line.resampled(fixed, count).reshape(-1, mesh.element.dim)
    cells = cells_at(mesh, ends)
    x = np.asarray(jax.lax.stop_gradient(mesh.points))[np.asarray(mesh.cells)[cells]]
    corners = x[:, : mesh.element.num_corners]
    spread = np.asarray(ends).reshape(*points.shape[:1], count, -1)
    along = np.asarray(np.gradient(spread, axis=1)).reshape(len(corners), -1)
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    extent = np.ptp(np.einsum("pai,pi->pa", corners, along), axis=1)
    return float(np.mean(extent))


def _directors(mesh: Mesh, ends, cells, rods: int) -> Float[Array, "points cell_nodes"] | None:
    """How the weights at the vertices change across the rod [1/m]: the solid takes a direction
    D of the section to sum (D . Grad N_a) x_a. In the plane none is needed."""
    dim = mesh.element.dim
    if dim == 2:
        return None
    spread = np.asarray(jax.lax.stop_gradient(ends)).reshape(rods, -1, dim)
    along = np.asarray(np.gradient(spread, axis=1)).reshape(-1, dim)
    sides = np.eye(dim)[np.argmin(np.abs(along), axis=1)]
    return jax.jvp(
        lambda at: locate(mesh, at, cells).weights,
        (ends,),
        (jnp.asarray(sides, ends.dtype),),
    )[1]
