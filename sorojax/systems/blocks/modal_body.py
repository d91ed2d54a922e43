"""A finite-element body reduced to a few shapes, as a block with the ports of the full one.

The shapes are eigenmodes, static responses to its loads, and their derivatives, which hold
how both change at large displacements.
"""

import abc
from collections.abc import Callable
from itertools import combinations_with_replacement
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.fem.checks import no_peaks
from sorojax.fem.equilibrium.response import tangent_solve
from sorojax.fem.loads.loads import has_masses
from sorojax.fem.problem import load_force, potential_energy, residual
from sorojax.material import Viscoelastic
from sorojax.math.linalg.sparse import SparseSymmetric, product
from sorojax.math.status import Status
from sorojax.systems.blocks.block import AbstractBlock, Input, Output
from sorojax.systems.blocks.driven import port_of, with_values
from sorojax.systems.blocks.fem_body import FemBody, damping_force

#: Shapes of which less than this share is new are left out.
_NEW = 1e-6
#: Reach beyond which a trained force is not trusted; a bellows' tip is off by 7 % at 1.22.
_FARTHEST = 1.25


class Basis(eqx.Module):
    """`shapes` of unit modal mass about the equilibrium `displacement` [m]."""

    displacement: Float[Array, "nodes dim"]
    shapes: Float[Array, "modes nodes dim"]

    def __len__(self) -> int:
        return self.shapes.shape[0]


def modal_basis(
    body: FemBody,
    modes: int = 4,
    *,
    displacement: Float[Array, "nodes dim"] | None = None,
    bending: bool = True,
) -> Basis:
    """Shapes for `modal_body(body, basis)`, made once.

    The lowest eigenmodes about an equilibrium; the static answer to each driven load, without
    which a pressure would find few modes to work on; and, with `bending`, the static
    derivatives of all these along each other, which let thin walls turn without being
    stretched. They are made orthonormal in the mass.

    Args:
        body: The body with the loads that hold it at the equilibrium.
        modes: Number of eigenmodes.
        displacement: The equilibrium [m]; at rest when omitted.
        bending: Add the derivatives: with n shapes up to n (n + 1) / 2 more.

    Returns:
        The shapes.

    Raises:
        ValueError: If a rod is mounted on the body, whose mass depends on its motion.

    Differentiable once outside `jit`, in the numbers of the body and in the displacement. Which
    shapes are new enough to be kept has no derivative. Eigenmodes of one frequency have none of
    their own; what depends only on the displacements that the shapes span has.

    Reference:
        Idelsohn, Cardona, A reduction method for nonlinear structural dynamic analysis,
        Comput. Methods Appl. Mech. Engrg. 49, 1985, for the derivatives.
    """
    problem = body.problem
    _constant_mass("modal_basis", body)
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    found = [fem.eigenmodes(problem, u, modes).shapes] if modes else []
    found.append(_answers(body, u))
    first = jnp.concatenate(found).reshape(-1, u.size)
    system, mass = problem.space.system, body.matter().mass
    chosen = orthonormal(system, mass, first)
    if bending:
        more = _shape_derivatives(problem, u, chosen.reshape(-1, *u.shape))
        chosen = orthonormal(system, mass, jnp.concatenate([chosen, more]))
    return Basis(u, chosen.reshape(-1, *u.shape))


def _answers(body: FemBody, u) -> Float[Array, "loads nodes dim"]:
    """Static displacements by a unit of each component of each driven load."""
    problem = body.problem
    now = {name: load.value for name, load in body.drives.items()}
    if not now:
        return jnp.zeros((0, *u.shape), u.dtype)

    def force(values):
        loads = with_values(problem.loads, values)
        return load_force(eqx.tree_at(lambda p: p.loads, problem, loads), u).ravel()

    slopes = jax.jacfwd(force)(now)
    rows = [jnp.moveaxis(s, 0, -1).reshape(-1, u.size) for s in slopes.values()]
    found = tangent_solve(problem, u, jnp.concatenate(rows))
    return found.reshape(-1, *u.shape)


def _shape_derivatives(problem: fem.Problem, u, shapes) -> Float[Array, "pairs dofs"]:
    """How each shape changes, in equilibrium, on the way along another."""
    first, second = np.triu_indices(shapes.shape[0])

    def curvature(pair):
        a, b = shapes[pair[0]], shapes[pair[1]]

        def along(u):
            return jax.jvp(lambda u: residual(problem, u), (u,), (a,))[1]

        return jax.jvp(along, (u,), (b,))[1].ravel()

    pairs = jnp.asarray(np.stack([first, second], axis=1))
    forces = jax.lax.map(curvature, pairs)
    return tangent_solve(problem, u, -forces)


def orthonormal(
    system: SparseSymmetric, mass: Float[Array, " nnz"], rows: Float[Array, "rows dofs"]
) -> Float[Array, "kept dofs"]:
    """The rows one after the other, each without what those before it hold, by Gram and
    Schmidt; a row that holds next to nothing new is left out.

    The combinations are found on the host and held; what they make is orthonormal, so its
    Cholesky factor is one, with the derivative of the method.
    """
    mix = _combinations(system, *(np.asarray(jax.lax.stop_gradient(x)) for x in (mass, rows)))
    made = jnp.asarray(mix) @ rows
    weighed = jax.vmap(lambda row: product(system, mass, row))(made)
    factor = jnp.linalg.cholesky(made @ weighed.T)
    return jax.scipy.linalg.solve_triangular(factor, made, lower=True)


def _combinations(system, mass: np.ndarray, rows: np.ndarray) -> Float[np.ndarray, "kept rows"]:
    """Coefficients of the rows in each of the orthonormal ones that are kept."""
    kept: list[np.ndarray] = []
    heavy: list[np.ndarray] = []
    mixes: list[np.ndarray] = []
    for row, mix in zip(rows, np.eye(len(rows)), strict=True):
        size = np.sqrt(max(system.solver.product(mass, row) @ row, 0.0))
        if not size > 0:
            continue
        row, mix = row / size, mix / size
        for _ in range(2):
            for one, weighed, its in zip(kept, heavy, mixes, strict=True):
                share = weighed @ row
                row, mix = row - share * one, mix - share * its
        weighed = system.solver.product(mass, row)
        left = np.sqrt(max(weighed @ row, 0.0))
        if left > _NEW:
            kept.append(row / left)
            heavy.append(weighed / left)
            mixes.append(mix / left)
    return np.stack(mixes)


# A finite-element body in a few shapes, as a block with the ports of the full one


Modes = Float[Array, " modes"]


class Polynomial(eqx.Module):
    """A Taylor polynomial of the modal coordinates: symmetric tensors of rising order, the
    first axis that of the values."""

    terms: tuple[Float[Array, "..."], ...]

    def __call__(self, q: Modes) -> Float[Array, " values"]:
        total, scale = self.terms[0], 1.0
        for order, term in enumerate(self.terms[1:], start=1):
            scale = scale / order
            for _ in range(order):
                term = term @ q
            total = total + scale * term
        return total


class AbstractModalForce(eqx.Module):
    """Force of the body, and of loads that are not driven, on the modal coordinates."""

    @abc.abstractmethod
    def __call__(self, q: Modes) -> Modes:
        """The slope of the energy."""

    @abc.abstractmethod
    def energy(self, q: Modes) -> Float[Array, ""]:
        """Energy [J] above that at q = 0."""

    @property
    def is_trained(self) -> bool:
        """Whether it holds only as far as a training went."""
        return False

    def reach(self, q: Modes) -> Float[Array, ""]:
        """Strain over the largest of the training; 0 without one."""
        return jnp.zeros_like(q[0])


class TaylorForce(AbstractModalForce):
    """The force as a polynomial: a few small products, whatever the mesh."""

    slope: Polynomial

    def __call__(self, q):
        return self.slope(q)

    def energy(self, q):
        terms = self.slope.terms  # the integral of t^k from 0 to 1 is 1 / (k + 1)
        scaled = tuple(term / (k + 1) for k, term in enumerate(terms))
        return Polynomial(scaled)(q) @ q


class ProjectedForce(AbstractModalForce):
    """The force of the whole mesh, projected: one assembly of forces per call, no solve."""

    problem: fem.Problem
    basis: Basis

    def __call__(self, q):
        force = residual(self.problem, displacement(self.basis, q))
        return jnp.einsum("kni,ni->k", self.basis.shapes, force)

    def energy(self, q):
        rest = potential_energy(self.problem, self.basis.displacement)
        return potential_energy(self.problem, displacement(self.basis, q)) - rest


class ModalBody(AbstractBlock):
    """A body that moves in the shapes of a basis; made by `modal_body`. The state is {q, v}.

    Ports are those of the `FemBody` that it stands for, and `q`; of a trained body also
    `reach`, the strain over the largest of its training. Some tens of states of
    moderate stiffness: `Rosenbrock2()` or `Rodas4()` step it.

    Attributes:
        basis: Shapes of unit modal mass.
        force: Of the body on the modal coordinates.
        damping: Matrix [1/s].
        works: What each driven load works on, in the unit of work over that of the load: of
            a pressure its volume.
        ports: Of the driven loads: name, input, shape, unit, and the name of the volume.
        volumes: Of the pressures with a volume: name of the load, of the output of the
            volume, and of that of its rate.
        energies: Whether energies are outputs.
        pulls: Loads that are tendons: they do not push, whatever the input.
        markers: Places at q = 0 and how they move, by name.
        q, v: At the start.
    """

    basis: Basis
    force: AbstractModalForce
    damping: Float[Array, "modes modes"]
    works: dict[str, Polynomial]
    markers: dict[str, tuple[Array, Array]]
    q: Modes
    v: Modes
    ports: tuple[tuple[str, str, tuple[int, ...], str | None], ...] = eqx.field(static=True)
    volumes: tuple[tuple[str, str, str], ...] = eqx.field(static=True)
    energies: bool = eqx.field(static=True, default=False)
    pulls: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def inputs(self):
        return {port: Input(unit, shape, 0.0) for _, port, shape, unit in self.ports}

    @property
    def outputs(self):
        dim = self.basis.displacement.shape[1]
        ports = {"q": Output(None, self.q.shape)}
        for _, value, rate in self.volumes:
            ports |= {value: Output("m^3"), rate: Output("m^3/s")}
        ports |= {f"{name}_position": Output("m", (dim,)) for name in self.markers}
        if self.energies:
            ports |= {"kinetic_energy": Output("J"), "elastic_energy": Output("J")}
        if self.force.is_trained:
            ports |= {"reach": Output(None)}
        return ports

    def path_status(self, path):
        if not self.force.is_trained:
            return None
        reach = jax.vmap(self.force.reach)(jax.lax.stop_gradient(path["q"]))
        return Status.where(
            jnp.all(reach <= _FARTHEST), Status.successful, Status.outside_model
        )

    def initial_state(self):
        return {"q": self.q, "v": self.v}

    def output(self, name, t, state, inputs):
        q, v = state["q"], state["v"]
        if name == "q":
            return q
        if name == "kinetic_energy":
            return v @ v / 2
        if name == "elastic_energy":
            return self.force.energy(q)
        if name == "reach":
            return self.force.reach(q)
        for load, value, rate in self.volumes:
            if name == value:
                return self.works[load](q)[0]
            if name == rate:
                return jax.jvp(self.works[load], (q,), (v,))[1][0]
        place, moves = self.markers[name.removesuffix("_position")]
        return place + q @ moves

    def vector_field(self, t, state, inputs):
        q, v = state["q"], state["v"]
        total = -self.force(q) - self.damping @ v
        for load, port, *_ in self.ports:
            _, pull = jax.vjp(self.works[load], q)
            given = inputs[port].reshape(-1)
            if load in self.pulls:
                given = jnp.where(given >= 0, given, jnp.zeros_like(given))
            total = total + pull(given)[0]
        return {"q": v, "v": total}


def displacement(basis: Basis, q: Modes) -> Float[Array, "nodes dim"]:
    """Displacement [m] of every node.

    Args:
        basis: From `modal_basis`.
        q: Modal coordinates.

    Returns:
        Displacement [m].
    """
    return basis.displacement + jnp.tensordot(q, basis.shapes, 1)


def modal_body(body: FemBody, basis: Basis, *, order: int | None = 3) -> ModalBody:
    """The body in the shapes of `basis`; differentiable in the numbers of the body.

    Args:
        body: The full body.
        basis: From `modal_basis`.
        order: Of the polynomial that stands for the force, 1 (linear) to 3; None projects the
            force of the mesh itself, as far as the shapes reach, at the price of one
            assembly per evaluation.

    Returns:
        The reduced block, with the ports of `body`.

    Raises:
        ValueError: If a driven load is not proportional to its input, or a support is driven.
    """
    reducible("modal_body", body)
    if order is not None and order not in (1, 2, 3):
        raise ValueError(f"reduced: `order` must be 1, 2, 3 or None, got {order}.")
    values = {name: jnp.zeros_like(load.value) for name, load in body.drives.items()}
    free = body.loaded(values)
    rest = ProjectedForce(free, basis)
    force = rest if order is None else TaylorForce(_taylor(rest, len(basis), order))
    works = {name: _work(body, name, basis) for name in values}
    cavities = {n: x for n, x in body.drives.items() if isinstance(x, fem.Pressure)}
    zero = jnp.zeros(len(basis), basis.shapes.dtype)
    u = jnp.zeros_like(basis.displacement) if body.u is None else body.u - basis.displacement
    v = jnp.zeros_like(u) if body.v is None else body.v
    return ModalBody(
        basis,
        force,
        _damping(body, basis),
        works,
        {
            name: (_place(body, basis, node), basis.shapes[:, node])
            for name, node in body.markers
        },
        zero if body.u is None else coordinates(body, basis, u),
        zero if body.v is None else coordinates(body, basis, v),
        tuple(
            (name, port_of(load), load.value.shape, body.inputs[port_of(load)].unit)
            for name, load in body.drives.items()
        ),
        tuple(
            (name, port_of(x, "volume"), port_of(x, "volume_rate"))
            for name, x in cavities.items()
        ),
        body.energies,
        tuple(name for name, load in body.drives.items() if isinstance(load, fem.Tendon)),
    )


def reducible(where: str, body: FemBody) -> None:
    """Refuse a body that is not a function of a few coordinates and their rates."""
    if body.moved:
        raise ValueError(
            f"{where}: got driven supports {sorted(body.moved)}, need a body whose supports "
            "stay, as its shapes do. Keep the FemBody."
        )
    if isinstance(body.problem.material, Viscoelastic):
        raise ValueError(
            f"{where}: got a body of a Viscoelastic material, need one without memory. Give "
            "its `base` to the problem, with fem.Rayleigh(...) for damping."
        )
    no_peaks(where, body.problem.material)
    _constant_mass(where, body)


def _constant_mass(where: str, body: FemBody) -> None:
    if any(map(has_masses, body.problem.loads)):
        raise ValueError(
            f"{where}: got masses that are not at nodes, of a mounted rod, need a body of "
            "constant mass. Keep the FemBody."
        )


def _place(body: FemBody, basis: Basis, node: int) -> Array:
    return body.problem.mesh.points[node] + basis.displacement[node]


def coordinates(body: FemBody, basis: Basis, field) -> Modes:
    """Coordinates of a field of the nodes, nearest in the mass."""
    weighed = product(body.problem.space.system, body.matter().mass, field.ravel())
    return basis.shapes.reshape(len(basis), -1) @ weighed


def _damping(body: FemBody, basis: Basis) -> Float[Array, "modes modes"]:
    known = body.matter()
    forces = jax.vmap(lambda v: damping_force(body, known, basis.displacement, v))(basis.shapes)
    return basis.shapes.reshape(len(basis), -1) @ forces.T


def _work(body: FemBody, name: str, basis: Basis) -> Polynomial:
    """The displacement that a driven load does work on, to third order: all of a volume."""
    load = body.drives[name]

    def potential(value, q):
        own = eqx.tree_at(lambda load: load.value, load, value)
        return own.potential(body.problem, displacement(basis, q))

    def work(q, value=None):
        value = jnp.zeros_like(load.value) if value is None else value
        return -jax.grad(potential)(value, q).reshape(-1)

    zero = jnp.zeros(len(basis), basis.shapes.dtype)
    bent = [work(zero + 1e-6, s * jnp.ones_like(load.value)) for s in (0.0, 1.0)]
    if not is_traced(bent) and not np.allclose(bent[0], bent[1], rtol=1e-9, atol=0.0):
        raise ValueError(
            f"reduced: `{name}` is a {type(load).__name__}, whose force is not proportional "
            "to its input. Drive the body by pressures, forces or tendons."
        )
    return Polynomial(derivatives(work, zero, 3))


def derivatives(function: Callable[[Modes], Array], at: Modes, order: int) -> tuple:
    """Value and derivatives of a cheap function."""
    found: list[Any] = [function]
    for _ in range(order):
        found.append(jax.jacfwd(found[-1]))
    return tuple(jax.jit(f)(at) for f in found)


def _taylor(force: AbstractModalForce, count: int, order: int) -> Polynomial:
    """Derivatives of the force at rest, direction by direction."""
    eye = jnp.eye(count)
    terms = [force(jnp.zeros(count))]

    def along(function, d):
        return lambda q: jax.jvp(function, (q,), (d,))[1]

    def directional(picks):
        function: Callable[[Array], Array] = force
        for pick in picks:
            function = along(function, eye[pick])
        return function(jnp.zeros(count))

    for rank in range(1, order + 1):
        picks = np.array(list(combinations_with_replacement(range(count), rank)), np.int32)
        rows = jax.lax.map(directional, jnp.asarray(picks))
        at = {tuple(pick): number for number, pick in enumerate(picks.tolist())}
        every = np.indices((count,) * rank).reshape(rank, -1).T
        place = np.array([at[tuple(sorted(pick))] for pick in every.tolist()])
        full = rows[jnp.asarray(place)].reshape(*(count,) * rank, count)
        terms.append(jnp.moveaxis(full, -1, 0))
    return Polynomial(tuple(terms))
