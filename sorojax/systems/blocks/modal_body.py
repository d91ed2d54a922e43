"""A finite-element body reduced to a few shapes, as a block with the ports of the full one."""

import abc
from collections.abc import Callable
from itertools import combinations_with_replacement, zip_longest
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import fem
from sorojax._jax.trace_state import is_traced
from sorojax.fem.checks import no_peaks
from sorojax.fem.problem import potential_energy, residual
from sorojax.material import Viscoelastic
from sorojax.math.status import Status
from sorojax.systems.blocks.block import AbstractBlock, Input, Output
from sorojax.systems.blocks.driven import port_of
from sorojax.systems.blocks.fem_body import FemBody, damping_force
from sorojax.systems.blocks.modal_basis import (
    Basis,
    Modes,
    constant_mass,
    coordinates,
    displacement,
)
from sorojax.systems.blocks.modal_inertia import ModalInertia, modal_inertia
from sorojax.systems.blocks.surface_contact import (
    SurfaceContact,
    contacts_of,
    surface_contact,
)

#: Reach beyond which a trained force is not trusted; a bellows' tip is off by 6 % at 1.28.
_FARTHEST = 1.25


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

    def viscous(self, q: Modes, v: Modes) -> Modes:
        """Force of a viscosity that turns with the body."""
        return jnp.zeros_like(v)

    def tangent(self, q: Modes, rate: Float[Array, ""] | float) -> Float[Array, "modes modes"]:
        """Derivative by q, and `rate` [1/s] times that of the viscous force by v."""
        by_rates = jax.jacfwd(lambda v: self.viscous(q, v))(jnp.zeros_like(q))
        return jax.jacfwd(self)(q) + rate * by_rates

    @property
    def relaxation_times(self) -> Float[Array, " branches"] | None:
        """Of Maxwell branches beside the force [s]; None without any."""
        return None

    def with_branches(self, q: Modes, relaxed: Float[Array, "branches modes"]) -> Modes:
        """The slope of the energy with branches that are free of stress at `relaxed`."""
        return self(q)

    def stored_by_branches(self, q: Modes, relaxed: Float[Array, "branches modes"]) -> Array:
        """Energy of the branches [J]."""
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
    """A body that moves in the shapes of a basis; made by `modal_body`. The state is {q, v}; of
    a body that relaxes also `relaxed`: coordinates at which each branch has no stress.

    Ports are those of the `FemBody` that it stands for, and `q`; of a trained body also
    `reach`, the strain over the largest of its training. Some tens of states of
    moderate stiffness: `Rosenbrock2()` or `Rodas4()` step it.

    Attributes:
        basis: Shapes of unit modal mass.
        force: Of the body on the modal coordinates.
        damping: Matrix [1/s], of what is the same in every state.
        works: What each driven load works on, in the unit of work over that of the load: of
            a pressure its volume.
        ports: Of the driven loads: name, input, shape, unit, and the name of the volume.
        volumes: Of the pressures with a volume: name of the load, of the output of the
            volume, and of that of its rate.
        energies: Whether energies are outputs.
        pulls: Loads that are tendons: they do not push, whatever the input.
        inertia: Of a body that a frame carries; `CarryingBody` moves it with a link.
        contacts: Of its surface with shapes that do not deform; `Staggered()` moves it.
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
    inertia: ModalInertia | None = None
    contacts: tuple[SurfaceContact, ...] = ()

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
        known = jax.vmap(self.is_known)(jax.lax.stop_gradient(path["q"]))
        return Status.where(jnp.all(known), Status.successful, Status.outside_model)

    def is_known(self, q: Modes) -> Bool[Array, ""]:
        """Whether the strains are as far as the training allows, and nothing touches that
        touched nothing there."""
        clear = [one.clearance(q) > 0 for one in self.contacts]
        return jnp.all(jnp.stack([self.force.reach(q) <= _FARTHEST, *clear]))

    def initial_state(self):
        times = self.force.relaxation_times
        state: dict[str, Any] = {"q": self.q, "v": self.v}
        if self.contacts:
            state["stretch"] = tuple(one.unstretched() for one in self.contacts)
        if times is None:
            return state
        return state | {"relaxed": jnp.broadcast_to(self.q, (*times.shape, *self.q.shape))}

    def output(self, name, t, state, inputs):
        q, v = state["q"], state["v"]
        if name == "q":
            return q
        if name == "kinetic_energy":
            return v @ v / 2
        if name == "elastic_energy":
            stored = self.force.energy(q)
            if "relaxed" not in state:
                return stored
            return stored + self.force.stored_by_branches(q, state["relaxed"])
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
        if self.inertia is not None:
            raise ValueError(
                "ModalBody: got a body that a frame carries, need a link that moves it. Put "
                "systems.CarryingBody(arm, {link: body}) into the network."
            )
        if self.contacts:
            raise ValueError(
                "ModalBody: got a body in contact, whose friction remembers the steps before, "
                "and a method for differential equations, need one of fixed steps. Call "
                "simulate(network, duration, step=...) with Staggered(), its default."
            )
        q, times, relaxed = state["q"], self.force.relaxation_times, state.get("relaxed")
        rates = {"q": state["v"], "v": self.pull(q, state["v"], inputs, relaxed)}
        if times is None or relaxed is None:
            return rates
        return rates | {"relaxed": (q[None] - relaxed) / times[:, None]}

    def pull(
        self, q: Modes, v: Modes, inputs, relaxed: Float[Array, "branches modes"] | None = None
    ) -> Modes:
        """Force on the modal coordinates in a frame that rests."""
        force = self.force(q) if relaxed is None else self.force.with_branches(q, relaxed)
        return self.loads(inputs)(q) - force - self.damping @ v - self.force.viscous(q, v)

    def tangent(
        self, q: Modes, inputs, rate: Float[Array, ""] | float
    ) -> Float[Array, "modes modes"]:
        """Derivative of minus `pull` by q at v = 0, and `rate` [1/s] times that by v."""
        by_rates = rate * self.damping
        return self.force.tangent(q, rate) - jax.jacfwd(self.loads(inputs))(q) + by_rates

    def loads(self, inputs) -> Polynomial:
        """Force of the driven loads on the modal coordinates, as a function of these."""
        zero = jnp.zeros_like(self.q)
        terms = [zero]
        for load, port, *_ in self.ports:
            given = inputs[port].reshape(-1)
            if load in self.pulls:
                given = jnp.where(given >= 0, given, jnp.zeros_like(given))
            # the slope of a polynomial is one of the next lower order
            slope = [jnp.tensordot(given, term, 1) for term in self.works[load].terms[1:]]
            pairs = zip_longest(terms, slope)
            terms = [b if a is None else a if b is None else a + b for a, b in pairs]
        return Polynomial(tuple(terms))


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
        ValueError: If a driven load is not proportional to its input, or a support is driven,
            but for a `fem.Carried` that is the only one: see `CarryingBody`.
    """
    reducible("modal_body", body)
    if order is not None and order not in (1, 2, 3):
        raise ValueError(f"reduced: `order` must be 1, 2, 3 or None, got {order}.")
    inertia = _in_a_frame(body, basis) if body.moved else None
    touching = contacts_of(body.problem)
    contacts = tuple(surface_contact(body.problem, load, basis) for load in touching)
    body = without_contacts(without_weight(body))
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
        inertia,
        contacts,
    )


def reducible(where: str, body: FemBody) -> None:
    """Refuse a body that is not a function of a few coordinates and their rates."""
    carried = [s for s in body.moved.values() if isinstance(s, fem.Carried)]
    if body.moved and (len(carried) != 1 or len(body.problem.supports) != 1):
        raise ValueError(
            f"{where}: got driven supports {sorted(body.moved)}, need a body whose supports "
            "stay, as its shapes do, or one fem.Carried alone. Keep the FemBody."
        )
    if body.moved:
        _carriable(where, body)
    if isinstance(body.problem.material, Viscoelastic):
        raise ValueError(
            f"{where}: got a body of a Viscoelastic material, need one without memory. Give "
            "its `base` to the problem, with fem.Rayleigh(...) for damping."
        )
    touching = {load.name for load in contacts_of(body.problem)}
    if moved := sorted(touching & set(body.drives)):
        raise ValueError(
            f"{where}: got contacts with driven obstacles {moved}, need obstacles that stay. "
            "Keep the FemBody."
        )
    if touching and body.moved:
        raise ValueError(
            f"{where}: got contact {sorted(touching)} of a body that a frame carries, need a "
            "body whose supports stay. Keep the FemBody."
        )
    no_peaks(where, body.problem.material)
    constant_mass(where, body)


def _carriable(where: str, body: FemBody) -> None:
    """Refuse what does not turn with the frame that carries the body."""
    if body.u is not None or body.v is not None:
        raise ValueError(
            f"{where}: got `u` or `v` at the start, in the world, of a body that a frame "
            "carries, need one that begins at rest in its frame. Leave both out."
        )
    for load in body.problem.loads:
        driven = load.name in body.drives
        if isinstance(load, fem.Gravity) != driven and isinstance(load, _TURNING):
            continue
        need = "a weight that is not driven" if isinstance(load, fem.Gravity) else ""
        raise ValueError(
            f"{where}: got the load `{load.name}`, a {type(load).__name__}, on a body that a "
            f"frame carries, need {need or 'weight, and driven pressures or tendons'}. Keep "
            "the FemBody."
        )


_TURNING = (fem.Gravity, fem.Pressure, fem.Tendon)


def without_weight(body: FemBody) -> FemBody:
    """A body that a frame carries without its weight, which turns in the frame."""
    if not body.moved:
        return body
    loads = tuple(x for x in body.problem.loads if not isinstance(x, fem.Gravity))
    return eqx.tree_at(lambda b: b.problem.loads, body, loads)


def without_contacts(body: FemBody) -> FemBody:
    """A body that touches nothing."""
    if not contacts_of(body.problem):
        return body
    loads = tuple(x for x in body.problem.loads if not isinstance(x, fem.Contact))
    return eqx.tree_at(lambda b: b.problem.loads, body, loads)


def _in_a_frame(body: FemBody, basis: Basis) -> ModalInertia:
    """Inertia in the frame that carries the body."""
    problem = body.problem
    (support,) = body.moved.values()
    assert isinstance(support, fem.Carried) and support.rest is not None
    rest, dim = support.rest, problem.mesh.points.shape[1]
    weights = [x.value for x in problem.loads if isinstance(x, fem.Gravity)]
    gravity = sum(weights, jnp.zeros(dim, basis.shapes.dtype))
    points = problem.mesh.points + basis.displacement
    known = (problem.space.system, body.matter().mass, points, basis.shapes, rest, gravity)
    return modal_inertia(*known)


def _place(body: FemBody, basis: Basis, node: int) -> Array:
    return body.problem.mesh.points[node] + basis.displacement[node]


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
    return taylor(work, zero, 3)


def taylor(function: Callable[[Modes], Array], at: Modes, order: int) -> Polynomial:
    """A cheap function about a point, without the last terms where they are zero."""
    found: list[Any] = [function]
    for _ in range(order):
        found.append(jax.jacfwd(found[-1]))
    terms = [jax.jit(f)(at) for f in found]
    while not is_traced(terms) and len(terms) > 1 and not np.any(np.asarray(terms[-1])):
        terms.pop()
    return Polynomial(tuple(terms))


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
