"""Equilibrium as one differentiable operation of the numbers of a problem.

With concrete numbers the operation follows the load path on the host, one batch member after
another under `vmap`; inside a trace it is the compiled loop of `jit`. Its derivative is that
of the implicit function, R_u du = -R_p dp, and its transpose: one compiled program, one factor
and one back-substitution, in whichever direction it is asked for.
"""

import copy
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax._jax.trace_state import evaluated_now, is_traced, is_tracer
from sorojax._types import from_host
from sorojax.fem.equilibrium.jit import (
    Begin,
    Outcome,
    follow_traced,
    known_mask,
    prepare_traced,
)
from sorojax.fem.equilibrium.lanes import Lanes, lane_operation
from sorojax.fem.equilibrium.linear import linearise
from sorojax.fem.equilibrium.load_stepping import (
    Log,
    StartingPoint,
    Stats,
    at_rest,
    follow,
    scaled_features,
    solve_lanes,
)
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.problem import Problem, potential_energy, residual, unsupported, with_terms
from sorojax.fem.supports import known_dofs, known_values
from sorojax.math.linalg import sparse
from sorojax.math.linear_map import pushed


class _Record:
    """Record of solves on the host: one log each, lanes in row-major order; none in a trace.
    `displacement` is that of a single solve [m]."""

    def __init__(self):
        self.logs: list[Log] = []
        self.batched = False
        self.displacement: np.ndarray | None = None

    def keep(self, logs: list[Log], batched: bool) -> None:
        self.logs, self.batched, self.displacement = logs, batched, None


def _strong(x: Array) -> Array:
    """`jnp.asarray(3.0)` is of a weak type, for which every kernel would compile again."""
    return jnp.asarray(x, x.dtype) if getattr(x, "weak_type", False) else x


class Solve:
    """A problem and where to start from; compared by identity, so it may be a parameter."""

    def __init__(
        self,
        problem: Problem,
        begin: Begin | None,
        newton: Newton,
        steps: int,
        max_cuts: int,
        want_tangent: bool = False,
    ):
        # by hand: partition, filter and combine take as long as a small solve
        self._all, self._tree = jax.tree.flatten((problem, begin))
        self._places = [k for k, leaf in enumerate(self._all) if eqx.is_array(leaf)]
        self.leaves = [_strong(self._all[k]) for k in self._places]
        self.traced = [k for k, leaf in enumerate(self.leaves) if is_tracer(leaf)]
        last = len(jax.tree.leaves(begin))
        self.num_problem_leaves = sum(k < len(self._all) - last for k in self._places)
        self.settings = (newton, steps, max_cuts)
        self.shape = problem.mesh.points.shape
        self.num_all_values = problem.space.system.num_values
        self.num_values = self.num_all_values if want_tangent else 0
        self.record = _Record()

    def complete(self, traced) -> list:
        """All leaves, from those that some transformation acts on."""
        leaves = list(self.leaves)
        for k, leaf in zip(self.traced, traced, strict=True):
            leaves[k] = leaf
        return leaves

    def inputs(self, leaves) -> tuple[Problem, Begin | None]:
        return self._with(leaves, self._all)

    def _with(self, leaves, others):
        """Problem and start with `leaves` for arrays and what `others` has for the rest."""
        values = list(others)
        for place, leaf in zip(self._places, leaves, strict=True):
            values[place] = leaf
        return jax.tree.unflatten(self._tree, values)

    def problem(self, leaves) -> Problem:
        return self.inputs(leaves)[0]

    def moving(self, leaves, dots) -> tuple[Problem, Problem, Problem]:
        """The problem in two: the numbers that move and all else, and how they move; `dots`
        are those of the traced leaves.

        Numbers without a derivative are left out, so that they cost nothing.
        """
        count = self.num_problem_leaves
        moved = {
            k: dot
            for k, dot in zip(self.traced, dots, strict=True)
            if k < count and not isinstance(dot, SymbolicZero)
        }
        all_leaves, none = range(len(leaves)), [None] * len(self._all)
        rest = [leaves[k] if k < count and k not in moved else None for k in all_leaves]
        params = [leaves[k] if k in moved else None for k in all_leaves]
        rates = [moved.get(k) for k in all_leaves]
        return (
            self._with(params, none)[0],
            self._with(rest, self._all)[0],
            self._with(rates, none)[0],
        )

    def with_tangent(self) -> "Solve":
        """The same call, that also returns the tangent; the record is shared."""
        other = copy.copy(self)
        other.num_values = self.num_all_values
        return other

    @property
    def stats(self) -> Stats | tuple[Stats, ...] | None:
        """The record of the one solve, of every lane, or `None` inside a trace."""
        found = tuple(log.stats() for log in self.record.logs)
        return found[0] if found and not self.record.batched else found or None


# How an equilibrium answers to small changes of its numbers: a linear map and its transpose


class Equilibrium(NamedTuple):
    """Data of the map: the numbers that move, all others, and the state.

    `values` are those of the tangent; the first of the `counts` of the solve is one where the
    state is no equilibrium, which has no derivative.
    """

    params: Problem
    rest: Problem
    u: Float[Array, "nodes dim"]
    values: Float[Array, " nnz"]
    counts: Float[Array, " 5"]


def response(at: Equilibrium, rates: Problem) -> Float[Array, "nodes dim"]:
    """du for the rates dp of the numbers that move, by operations that JAX differentiates."""
    system, matrix, known = _held_tangent(at)
    if jax.tree.leaves(at.params.supports):
        rhs, move = _moved_unbalance(at, rates, known)
        return _answer(system, matrix, rhs, at.u) + move
    rhs = _unbalance(_without_supports(at), unsupported(rates), known)
    return _answer(system, matrix, rhs, at.u)


def response_at_once(at: Equilibrium, rates: Problem) -> Float[Array, "nodes dim"]:
    """The same for a concrete equilibrium, as one operation."""
    moving, tree = jax.tree.flatten(rates)
    return pushed(moving, _Map(at, tree))[0]


class _Map:
    """An equilibrium as a `LinearMap`."""

    def __init__(self, at: Equilibrium, tree):
        self.at, self.tree = at, tree
        self.inputs, self.outputs = jax.tree.leaves(at.params), (at.u,)

    def push(self, *moving) -> tuple:
        return (response(self.at, jax.tree.unflatten(self.tree, moving)),)

    push_now = push

    def pull(self, *changes) -> list:
        return list(jax.linear_transpose(self.push, *self.inputs)(changes))

    def pull_now(self, *changes) -> list:
        """By one back-substitution and the derivative of one number, or with supports that
        move of the force and the displacement that they prescribe."""
        system, matrix, known = _held_on_host(self.at)
        force = np.where(known, 0.0, np.asarray(changes[0]).ravel())
        # the last factor of the solve belongs to the state before the last, small update
        work = system.solver.solve_near(matrix, force)
        if jax.tree.leaves(self.at.params.supports):
            return jax.tree.leaves(_pulled_with_supports(self.at, work, changes[0], known))
        return jax.tree.leaves(_pulled(_without_supports(self.at), work, known))


def _without_supports(at: Equilibrium) -> Equilibrium:
    return at._replace(params=unsupported(at.params), rest=unsupported(at.rest))


def _held_tangent(at: Equilibrium):
    """The system, the tangent with its supports, and which unknowns these decide."""
    problem = eqx.combine(at.params, at.rest)
    system = problem.space.system
    # Concrete numbers run one compiled program, not its operations for the trace.
    with evaluated_now(at):
        return system, *_held(system, problem.supports, at.values, at.u)


def _held_on_host(at: Equilibrium):
    """The same as arrays of the host."""
    system = eqx.combine(at.params.space.system, at.rest.space.system)
    known = known_dofs(eqx.combine(at.params.supports, at.rest.supports), *at.u.shape)
    return system, sparse.fixed_on_host(system, np.asarray(at.values), known), known


@eqx.filter_jit
def _held(system: sparse.SparseSymmetric, supports: tuple, values, u):
    known = known_mask(supports, *u.shape)
    return sparse.fix(system, values, known), known


# Few programs, each differentiated and transposed once: operation by operation the trace
# of a derivative costs more than the solve.


@jax.jit
def _unbalance(at: Equilibrium, rates: Problem, known: Bool[Array, " dofs"]):
    """-dR for the numbers that move, at displacements that stay."""

    def unbalanced(params):
        return residual(eqx.combine(params, at.rest), at.u).ravel()

    _, rate = jax.jvp(unbalanced, (at.params,), (rates,))
    return jnp.where(known, jnp.zeros_like(rate), -_valid(at) * rate)


@once
def _pulled(
    at: Equilibrium,
    work: Float[Array | np.ndarray, " dofs"],
    known: Bool[Array | np.ndarray, " dofs"],
):
    """-work . dR by each of these numbers."""
    way = jnp.where(known, jnp.zeros_like(work), -_valid(at) * work).reshape(at.u.shape)

    def along(params):
        def energy(u):
            return potential_energy(eqx.combine(params, at.rest), u)

        return jax.jvp(energy, (at.u,), (way,))[1]

    return jax.grad(along)(at.params)


@once
def _moved_unbalance(at: Equilibrium, rates: Problem, known: Bool[Array | np.ndarray, " dofs"]):
    """-dR with the displacements that supports prescribe, and how these move [m]."""

    def prescribed(params):
        return known_values(eqx.combine(params, at.rest).supports, *at.u.shape)

    def unbalanced(params, u):
        return residual(eqx.combine(params, at.rest), u).ravel()

    _, move = jax.jvp(prescribed, (at.params,), (rates,))
    move = _valid(at) * move.reshape(at.u.shape)
    _, rate = jax.jvp(unbalanced, (at.params, at.u), (rates, move))
    return jnp.where(known, jnp.zeros_like(rate), -_valid(at) * rate), move


@once
def _pulled_with_supports(
    at: Equilibrium,
    work: Float[Array | np.ndarray, " dofs"],
    change: Float[Array, "nodes dim"],
    known: Bool[Array | np.ndarray, " dofs"],
) -> Problem:
    """What `_moved_unbalance` gives of `work` and of a change of the displacements."""

    def moved(rates: Problem):
        return _moved_unbalance(at, rates, known)

    return jax.linear_transpose(moved, at.params)((work, change))[0]


@jax.jit
def _answer(system: sparse.SparseSymmetric, matrix, rhs, u):
    return sparse.solve(system, matrix, rhs).reshape(u.shape)


def _valid(at: Equilibrium) -> Float[Array, ""]:
    """1, or NaN where there is no derivative: a factor keeps the map linear."""
    failed = at.counts[0]
    return jnp.where(failed == 0, jnp.ones_like(failed), jnp.nan)


# Equilibrium as a function of the numbers of a problem, for every transformation


#: Last relative update below which the tangent assembled before it is as good as exact.
_SHARP = 1e-5


def equilibrium(call: Solve) -> Outcome:
    """Equilibrium of the problem of `call`; the host's record of it is in `call` then."""
    return Outcome(*_equilibrium(call, [call.leaves[k] for k in call.traced]))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _equilibrium(call: Solve, traced):
    return _solved(call, traced)


def _solved(call: Solve, traced):
    return _equilibrium_of(call, call.complete(traced))


def _derivative(call: Solve, primals, tangents):
    (traced,), (dots,) = primals, tangents
    concrete = not is_traced(traced)
    # what is staged for a derivative, or as the rule of one, costs as much as a factor
    with evaluated_now(traced):
        solve = _solved if concrete else _equilibrium
        u, counts, values = solve(call.with_tangent(), traced)
        at, rates = _linearised_at(call, traced, dots, u, counts, values)
        if call.num_values != call.num_all_values:
            values = jax.lax.slice_in_dim(values, 0, call.num_values)
    u_dot = response_at_once(at, rates) if concrete else response(at, rates)
    still = (SymbolicZero(jax.typeof(x).to_tangent_aval()) for x in (counts, values))
    return (u, counts, values), (u_dot, *still)


_equilibrium.defjvp(_derivative, symbolic_zeros=True)


def _linearised_at(call: Solve, traced, dots, u, counts, values):
    """The rule for du of R(u, params) = 0, with prescribed displacements moving along."""
    leaves = call.complete(traced)
    params, rest, rates = call.moving(leaves, dots)
    if call.settings[0].step_tolerance > _SHARP:
        problem = call.problem(leaves)
        values = linearise(problem, _prepare_traced(problem), u, u).values
    elif is_traced(traced):
        values = _tangent_values(call, traced, u, values)
    return Equilibrium(params, rest, u, values, counts), rates


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _tangent_values(call: Solve, traced, u, values):
    """The tangent that the last check of the residual assembled. It differs from the exact
    one by the square of the last update; only its own derivative needs new work."""
    return values


def _tangent_values_derivative(call: Solve, primals, tangents):
    (traced, u, values), (dots, u_dot, _) = primals, tangents
    params, rest, params_dot = call.moving(call.complete(traced), dots)
    u_dot = jnp.zeros_like(u) if isinstance(u_dot, SymbolicZero) else u_dot

    def assembled(params, u):
        problem = eqx.combine(params, rest)
        return linearise(problem, _prepare_traced(problem), u, u).values

    _, change = jax.jvp(assembled, (params, u), (params_dot, u_dot))
    return _tangent_values(call, traced, u, values), change


_tangent_values.defjvp(_tangent_values_derivative, symbolic_zeros=True)


_prepare_traced = eqx.filter_jit(prepare_traced)


def _alone(call: Solve, leaves) -> Outcome:
    log = Log(*call.settings)
    call.record.keep([log], False)
    u = call.record.displacement = _follow(*call.inputs(leaves), log)
    return _outcome(call, u, log)


def _follow(problem: Problem, begin: Begin | None, log: Log) -> np.ndarray:
    if begin is None:
        return follow(problem, at_rest(problem), log)
    u = np.asarray(begin.u)
    if not np.all(np.isfinite(u)):
        log.reason = "the state to start from is no equilibrium"
        return u
    if begin.terms is not None:
        start = with_terms(problem, begin.terms)
        return follow(problem, StartingPoint(u, start, begin.tangent), log)
    # from a guess at full load; from rest along the load if it is too far away
    once = Log(log.newton, 1, 0)
    u = follow(problem, StartingPoint(u, problem, begin.tangent), once)
    if once.reason:
        return follow(problem, at_rest(problem), log)
    log.steps, log.end = once.steps, once.end
    return u


def _outcome(call: Solve, u: np.ndarray, log: Log) -> Outcome:
    stats = log.stats()
    done = stats.steps[-1].fraction if stats.steps else 0.0
    numbers = bool(log.reason), done, stats.iterations, stats.cuts, len(stats.steps)
    counts = np.array(numbers, u.dtype)
    tangent = np.zeros(call.num_values, u.dtype)
    if call.num_values and not log.reason:
        tangent = log.end.tangent
    return Outcome(from_host(u), from_host(counts), from_host(tangent))


def _side_by_side(call: Solve, lanes: Lanes) -> list[Outcome]:
    """Every lane with its own record; lanes from rest help one another."""
    logs = [Log(*call.settings) for _ in range(lanes.count)]
    call.record.keep(logs, True)
    if call.inputs(lanes.rows)[1] is None:
        pairs = list(zip(lanes.rows, lanes.batched, strict=True))
        varying = [x for x, b in pairs if b and x.dtype.kind == "f"]
        body = call.inputs(list(lanes.batched))[0]
        shape = jax.tree.leaves((body.mesh, body.kinematics, body.formulation))
        same_body = not any(leaf is True for leaf in shape)
        features = scaled_features(varying)
        answers = solve_lanes(lambda k: call.problem(lanes.lane(k)), features, logs, same_body)
    else:
        answers = [_follow(*call.inputs(lanes.lane(k)), log) for k, log in enumerate(logs)]
    return [_outcome(call, u, log) for u, log in zip(answers, logs, strict=True)]


def _in_trace(call: Solve, leaves) -> list[Any]:
    u, counts, tangent = follow_traced(*call.inputs(leaves), *call.settings)
    return [u, counts, tangent[: call.num_values]]


_equilibrium_of = lane_operation(
    "fem_equilibrium",
    _alone,
    _side_by_side,
    _in_trace,
    lambda call: (call.shape, (5,), (call.num_values,)),
)
