"""One time step as a problem of equilibrium, and the state after it, as pure functions.

Forces act at one displacement u within the step. Velocity and acceleration there are affine
in u, so that inertia and damping are quadratic potentials beside those of the loads, which
may depend on the state at the begin of the step (`StepState`).
"""

from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from sorojax.fem.dynamics.damping import AbstractDamping, lumped_mass, nodal_mass
from sorojax.fem.dynamics.methods import Coefficients, Conserving
from sorojax.fem.equilibrium.jit import known_mask
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.problem import Problem, body, exchanged, load_potential, residual, with_terms
from sorojax.fem.relaxation import Peaks, Strains, after_step, in_step, moduli, raised_peaks
from sorojax.fem.supports import AbstractSupport, Prescribed, known_components, known_values
from sorojax.material.viscoelastic import Terms
from sorojax.math.linalg import sparse


class StepState(NamedTuple):
    """A time step before it is solved.

    Forces act at one state u within the step, whose velocity is `rate * (u - back)`.

    Attributes:
        u: Displacement at the start of the step [m].
        v: Velocity at the start of the step [m/s].
        back: Displacement that the velocity is counted from [m].
        rate: Velocity over displacement from `back` [1/s].
        guess: Explicit prediction of the state that forces act at [m].
        t: Time of that state [s].
        step: Size of the step [s].
        share: How far within the step the state is that forces act at.
        a: Acceleration at the start of the step [m/s^2]; None at an instant, of no step.
        scheme: The method; None at an instant.
    """

    u: Float[Array, "nodes dim"]
    v: Float[Array, "nodes dim"]
    back: Float[Array, "nodes dim"]
    rate: Float[Array, ""]
    guess: Float[Array, "nodes dim"]
    t: Float[Array, ""]
    step: Float[Array, ""]
    share: Float[Array, ""] | float = 1.0
    a: Float[Array, "nodes dim"] | None = None
    scheme: Coefficients | None = None


# Inertia and damping of one time step, as a quadratic potential


Mass = Literal["consistent", "lumped"]


class Inertia(AbstractLoad):
    """Potential d'A d / 2 - pull . d of the displacement d from `origin`.

    A holds the mass over the square of the step and the damping over the step, `pull` [N]
    what the state before the step brings along.
    """

    matrix: Float[Array, " nnz"]
    pull: Float[Array, " dofs"]
    origin: Float[Array, "nodes dim"]
    value: Float[Array, ""]
    name: str = eqx.field(static=True, default="inertia")
    smooth: ClassVar[bool] = True

    def potential(self, problem, u):
        d = (u - self.origin).ravel()
        return _half_square(problem.space.system, self.matrix, d) - jnp.sum(self.pull * d)

    def curved_part(self, problem):
        return None

    def tangent_values(self, problem):
        return self.matrix


@jax.custom_jvp
def _half_square(system: sparse.SparseSymmetric, values, d) -> Float[Array, ""]:
    """d' A d / 2, whose slope takes one product with the matrix instead of three."""
    return 0.5 * jnp.sum(d * sparse.product(system, values, d))


def _half_square_slope(primals, tangents):
    system, values, d = primals
    _, values_dot, d_dot = tangents
    force = sparse.product(system, values, d)
    slope = jnp.zeros((), d.dtype)
    if not isinstance(d_dot, SymbolicZero):
        slope = slope + jnp.sum(force * d_dot)
    if not isinstance(values_dot, SymbolicZero):
        slope = slope + 0.5 * jnp.sum(d * sparse.product(system, values_dot, d))
    return 0.5 * jnp.sum(d * force), slope


_half_square.defjvp(_half_square_slope, symbolic_zeros=True)


def mass_values(problem: Problem, mass: Mass) -> Float[Array, " nnz"]:
    """Mass matrix of the nodes [kg] as values in the pattern of the tangent."""
    if mass == "consistent":
        return nodal_mass(problem)
    system, lumped = problem.space.system, lumped_mass(problem)
    spread = lumped[system.rows]
    return jnp.where(system.rows == system.cols, spread, jnp.zeros_like(spread))


# One time step as a problem of equilibrium, and the state after it; pure functions


Row = Float[Array, "grid ..."]


class State(eqx.Module):
    """A moving body at one instant: what continues.

    `time` [s], and of the nodes `displacement` [m], `velocity` [m/s] and `acceleration`
    [m/s^2], which is that of the method.

    `memory` holds the loads that remember, such as friction; `work` and `dissipated` [J] are
    what loads and supports gave and damping took since the start. `strains` are what the
    branches of a viscoelastic material remember, `peaks` [J/m^3] what one that softens does
    (`fem.relaxation`). `share` is the part of a step that was taken last, `tangent` the matrix
    whose factor goes on being used and `listed` the displacement [m] that lists of near facets
    were made at, so that a run that is cut in two repeats the whole one to the last bit.
    """

    time: Float[Array, ""]
    displacement: Float[Array, "nodes dim"]
    velocity: Float[Array, "nodes dim"]
    acceleration: Float[Array, "nodes dim"]
    memory: tuple[AbstractLoad | None, ...]
    work: Float[Array, ""]
    dissipated: Float[Array, ""]
    share: Float[Array, ""]
    tangent: Float[Array, " nnz"] | None = None
    listed: Float[Array, "nodes dim"] | None = None
    strains: Strains | None = None
    peaks: Peaks | None = None


class Dynamics(eqx.Module):
    """All that a motion depends on.

    Attributes:
        problem, damping: The body, and what damps it.
        scheme: Of the method.
        loads, supports: A row of values on the grid of times for those that follow one.
        start: State that the motion begins with.
        step: Distance of the grid [s].
        mass: "consistent" or "lumped".
        conserves: Whether forces of the body keep its energy.
    """

    problem: Problem
    damping: tuple[AbstractDamping, ...]
    scheme: Coefficients
    loads: tuple[Row | None, ...]
    supports: tuple[Row | None, ...]
    start: State
    step: Float[Array, ""]
    mass: Mass = eqx.field(static=True)
    conserves: bool = eqx.field(static=True, default=False)


class Matter(NamedTuple):
    """Mass matrix, constant part of the damping matrix and shear moduli of the branches of a
    viscoelastic material [Pa], computed once per motion."""

    mass: Float[Array, " nnz"]
    damping: Float[Array, " nnz"] | None
    moduli: Terms | None = None


class Interval(NamedTuple):
    """A step: from `begin` to `end`, in steps of the grid from its point `index` on."""

    index: Int[Array, ""]
    begin: Float[Array, ""]
    end: Float[Array, ""]


class TimeStep(NamedTuple):
    """A step to solve. `matrix` is the damping matrix; `terms` are the loads and supports of
    its problem of equilibrium, and a material that remembers as it is then; `target` are
    displacements known at the end. Inertia pulls by the mass times `drive` [m/s^2] minus the
    damping times `lead` [m/s], the velocity where forces act of a body that keeps its
    displacement."""

    terms: tuple
    guess: Float[Array, "nodes dim"]
    predicted: Float[Array, "nodes dim"]
    matrix: Float[Array, " nnz"] | None
    target: Float[Array, " dofs"]
    lead: Float[Array, "nodes dim"]
    drive: Float[Array, "nodes dim"]


def matter(dynamics: Dynamics) -> Matter:
    """Mass and constant damping of the body."""
    problem = body(dynamics.problem)
    mass = mass_values(exchanged(problem, loads=dynamics.problem.loads), dynamics.mass)
    rest = jnp.zeros_like(problem.mesh.points)
    constant = [d.matrix(problem, mass, rest) for d in dynamics.damping if d.constant]
    damping = sum(constant[1:], start=constant[0]) if constant else None
    return Matter(mass, damping, moduli(problem))


def begin_step(dynamics: Dynamics, known: Matter, state: State, interval: Interval) -> TimeStep:
    """The problem of equilibrium of a step."""
    c = dynamics.scheme
    h = _size(dynamics, interval)
    u, v, a = state.displacement, state.velocity, state.acceleration
    rate, c2 = c.gamma / (c.beta * h), (1 - c.am) / (c.beta * h**2 * (1 - c.af))
    lead = (1 - (1 - c.af) * c.gamma / c.beta) * v
    lead = lead + (1 - c.af) * (1 - c.gamma / (2 * c.beta)) * h * a  # -rate * (back - u)
    drive = (1 - c.am) * (v / (c.beta * h) + (1 / (2 * c.beta) - 1) * a) - c.am * a
    guess = u + (1 - c.af) * h * v
    time = state.time + (1 - c.af) * h
    stage = StepState(u, v, u - lead / rate, rate, guess, time, h, 1 - c.af, a, c)
    loads = _begun(dynamics, state, interval, c.af, stage)
    damping = damping_matrix(dynamics, known, guess)
    matrix, pull = c2 * known.mass, _times(dynamics, known.mass, drive)
    if damping is not None:
        matrix = matrix + rate * damping
        pull = pull - _times(dynamics, damping, lead)
    inertia = Inertia(matrix, pull, u, jnp.zeros((), u.dtype))
    extra: tuple[AbstractLoad, ...] = (inertia,)
    if dynamics.conserves:
        extra += (Conserving(u, jnp.zeros((), u.dtype)),)
    target, supports = _held(dynamics, interval, c.af, u)
    predicted = guess
    if all(load.smooth for load in dynamics.problem.loads):
        predicted = guess + (1 - c.af) * h**2 / 2 * a  # that of an impact is not the next one
    terms = (loads + extra, supports)
    if state.strains is not None or state.peaks is not None:
        past = known.moduli, state.strains, (1 - c.af) * h, state.peaks
        terms += in_step(dynamics.problem, *past)
    return TimeStep(terms, guess, predicted, damping, target, lead, drive)


def end_step(
    dynamics: Dynamics,
    known: Matter,
    state: State,
    interval: Interval,
    step: TimeStep,
    u_alpha: Float[Array, "nodes dim"],
    work: Float[Array, ""] | None = None,
    taken: Float[Array, ""] | None = None,
) -> State:
    """The state after a step whose equilibrium is `u_alpha`; pass the `work` of loads and
    supports and what damping has `taken` in it [J] where they are known."""
    c = dynamics.scheme
    h = _size(dynamics, interval)
    u, v, a = state.displacement, state.velocity, state.acceleration
    d = (u_alpha - u) / (1 - c.af)
    a_new = (d - h * v) / (c.beta * h**2) - (1 / (2 * c.beta) - 1) * a
    v_new = v + h * ((1 - c.gamma) * a + c.gamma * a_new)
    loads = step.terms[0][: len(dynamics.problem.loads)]
    memory = tuple(
        None if m is None else load for m, load in zip(state.memory, loads, strict=True)
    )
    if work is None:
        work = _work(dynamics, step, loads, u_alpha, d)
    if taken is None:
        taken = _taken(dynamics, step, (1 - c.af) * v_new + c.af * v, d)
    strains, peaks = state.strains, state.peaks
    if strains is not None or peaks is not None:
        args = body(dynamics.problem), known.moduli, strains, h, u + d, peaks
        strains, relaxing = after_step(*args)
        peaks, softening = raised_peaks(*args)
        taken = taken + (relaxing if peaks is None else relaxing + softening)
    return State(
        time=state.time + h,
        displacement=u + d,
        velocity=v_new,
        acceleration=a_new,
        memory=memory,
        work=state.work + work,
        dissipated=state.dissipated + taken,
        share=state.share,
        strains=strains,
        peaks=peaks,
    )


def _work(dynamics: Dynamics, step: TimeStep, loads, u_alpha, d) -> Float[Array, ""]:
    """Work [J] of loads and supports in a step, with the forces that the step takes."""
    problem = with_terms(dynamics.problem, step.terms)
    loaded = exchanged(problem, loads=tuple(load.without_inertia() for load in loads))
    work = -jax.jvp(lambda u: load_potential(loaded, u), (u_alpha,), (d,))[1]
    if all(support.ramped is None for support in dynamics.problem.supports):
        return work
    reaction = residual(problem, u_alpha)
    mask = known_mask(problem.supports, *d.shape).reshape(d.shape)
    return work + jnp.sum(jnp.where(mask, reaction * d, jnp.zeros_like(d)))


def _taken(dynamics: Dynamics, step: TimeStep, v_alpha, d) -> Float[Array, ""]:
    """Energy that damping dissipates in a step [J]."""
    if step.matrix is None:
        return jnp.zeros((), d.dtype)
    return jnp.sum(_times(dynamics, step.matrix, v_alpha) * d.ravel())


def _size(dynamics: Dynamics, interval: Interval) -> Float[Array, ""]:
    return (interval.end - interval.begin) * dynamics.step


def _times(dynamics: Dynamics, values, x: Float[Array, "nodes dim"]) -> Float[Array, " dofs"]:
    return sparse.product(dynamics.problem.space.system, values, x.ravel())


def _at(row: Row, index, share) -> Float[Array, "..."]:
    """A row of values between two points of the grid."""
    first, last = row[index], row[index + 1]
    return first + share * (last - first)


def loads_at(dynamics: Dynamics, state: State, at: Callable[[Row], Array]) -> tuple:
    """The loads as they remember, those with a row of values with the one that `at` takes."""
    found = []
    rows = zip(dynamics.problem.loads, dynamics.loads, state.memory, strict=True)
    for load, row, before in rows:
        value = load.value if row is None else at(row)
        kept = load if before is None else before
        found.append(eqx.tree_at(lambda load: load.value, kept, value))
    return tuple(found)


def _begun(dynamics: Dynamics, state: State, interval: Interval, af, stage: StepState):
    share = interval.end - af * (interval.end - interval.begin)
    loads = loads_at(dynamics, state, lambda row: _at(row, interval.index, share))
    bare = body(dynamics.problem)
    return tuple(load.begun(bare, stage) for load in loads)


def damping_matrix(dynamics: Dynamics, known: Matter, guess):
    problem = body(dynamics.problem)
    varying = [d.matrix(problem, known.mass, guess) for d in dynamics.damping if not d.constant]
    if known.damping is not None:
        varying.append(known.damping)
    return sum(varying[1:], start=varying[0]) if varying else None


def _held(dynamics: Dynamics, interval: Interval, af, u):
    """Displacements known at the end, and supports that hold them where forces act."""
    supports = []
    for support, row in zip(dynamics.problem.supports, dynamics.supports, strict=True):
        if row is not None and support.ramped is not None:
            field = support.ramped
            support = eqx.tree_at(
                lambda s, field=field: getattr(s, field),
                support,
                _at(row, interval.index, interval.end),
            )
        supports.append(support)
    return held_within(tuple(supports), af, u)


def held_within(
    supports: tuple[AbstractSupport, ...], af, u: Float[Array, "nodes dim"]
) -> tuple[Float[Array, " dofs"], tuple[AbstractSupport, ...]]:
    """Displacements that `supports` know at the end of a step from `u`, and supports that
    hold the nodes on the way there, where forces act."""
    target = known_values(supports, *u.shape)
    held = (1 - af) * target.reshape(u.shape) + af * u
    dim = u.shape[1]
    fixed = []
    for support in supports:
        columns = jnp.asarray(known_components(support, dim))
        moved = held[support.nodes][:, columns]
        fixed.append(Prescribed(support.nodes, moved, support.components))
    return target, tuple(fixed)
