"""Equilibrium as a function of the numbers of a problem, for every transformation.

One primitive stands for the solve. With concrete numbers it follows the load path on the
host, lane after lane under `vmap`; inside a trace it becomes the loop of `traced`. Its
derivative is that of the implicit function: one factor of the tangent at equilibrium and
one back-substitution for each right-hand side, all of them at once.
"""

import contextlib
import functools
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from sorojax._types import is_traced
from sorojax.fem.energy_form import residual
from sorojax.fem.follow import Log, Start, begin_at, follow
from sorojax.fem.lanes import scaled_features, solve_lanes
from sorojax.fem.linear import Linearised, linearise, prepare
from sorojax.fem.newton import Newton
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_values
from sorojax.fem.traced import Begin, Outcome, follow_traced, prepare_traced, with_terms
from sorojax.math import sparse

_equilibrium_p = Primitive("fem_equilibrium")
_equilibrium_p.multiple_results = True


class Solve:
    """One call of the primitive: all that is no array, and what the host found.

    `logs` has one record per solve after a call with concrete numbers, lanes in row-major
    order, and stays empty inside a trace.
    """

    def __init__(
        self,
        problem: Problem,
        begin: Begin | None,
        newton: Newton,
        steps: int,
        max_cuts: int,
        want_tangent: bool = False,
    ):
        arrays, self._static = eqx.partition((problem, begin), eqx.is_array)
        self.leaves, self._tree = jax.tree.flatten(arrays)
        self.num_problem_leaves = len(jax.tree.leaves(eqx.filter(problem, eqx.is_array)))
        self.settings = (newton, steps, max_cuts)
        self.shape = problem.mesh.points.shape
        self.num_values = problem.space.system.num_values if want_tangent else 0
        self.logs: list[Log] = []

    def inputs(self, leaves) -> tuple[Problem, Begin | None]:
        return eqx.combine(jax.tree.unflatten(self._tree, leaves), self._static)

    def problem(self, leaves) -> Problem:
        return self.inputs(leaves)[0]

    def __call__(self) -> Outcome:
        leaves, self.leaves = self.leaves, []
        return Outcome(*_equilibrium(self, leaves))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _equilibrium(call: Solve, leaves):
    batched = (False,) * len(leaves)
    return tuple(_equilibrium_p.bind(*leaves, call=call, lead=(), batched=batched))


@_equilibrium.defjvp
def _derivative(call: Solve, primals, tangents):
    (leaves,), (dots,) = primals, tangents
    u, counts, tangent = _equilibrium(call, leaves)
    problem = call.problem(leaves)
    begin = leaves[call.num_problem_leaves :]
    moving = [d if eqx.is_inexact_array(x) else None for d, x in zip(dots, leaves, strict=True)]
    dots = call.problem(moving[: call.num_problem_leaves] + [None] * len(begin))
    u_dot = _tangent(problem, u, eqx.filter(dots, eqx.is_inexact_array))
    # a state that is no equilibrium has no derivative; a factor keeps the rule linear
    valid = jnp.where(counts[0] == 0, jnp.ones_like(counts[0]), jnp.nan)
    return (u, counts, tangent), (u_dot * valid, 0 * counts, 0 * tangent)


def _tangent(problem: Problem, u, params_dot):
    """du of R(u, params) = 0, with prescribed displacements moving along."""
    params, rest = eqx.partition(problem, eqx.is_inexact_array)
    nodes, dim = u.shape

    def known(params):
        return known_values(eqx.combine(params, rest).supports, nodes, dim)

    def unbalanced(params, u):
        return residual(eqx.combine(params, rest), u).ravel()

    _, move = jax.jvp(known, (params,), (params_dot,))
    directions = (params_dot, move.reshape(u.shape))
    _, rhs = jax.jvp(unbalanced, (params, u), directions)
    # Concrete numbers run the programs that the solve compiled, not copies for the trace.
    concrete = not is_traced((problem, u))
    with jax.core.eval_context() if concrete else contextlib.nullcontext():
        prepared = prepare(problem) if concrete else eqx.filter_jit(prepare_traced)(problem)
        values = linearise(problem, prepared, u, u).values
        matrix = sparse.fix(problem.space.system, values, prepared.known)
    rhs = jnp.where(prepared.known, jnp.zeros_like(rhs), -rhs)
    return (sparse.solve(problem.space.system, matrix, rhs) + move).reshape(u.shape)


@_equilibrium_p.def_impl
def _on_host(*leaves, call: Solve, lead: tuple[int, ...], batched: tuple[bool, ...]):
    with jax.core.eval_context():
        if lead:
            return _lanes_on_host(leaves, call, lead, batched)
        log = Log(*call.settings)
        call.logs[:] = [log]
        u = _follow(*call.inputs(leaves), log)
        return _outcome(call, u, log)


def _follow(problem: Problem, begin: Begin | None, log: Log) -> np.ndarray:
    if begin is None:
        return follow(problem, begin_at(problem, None), log)
    u = np.asarray(begin.u)
    if not np.all(np.isfinite(u)):
        log.reason = "the state to start from is no equilibrium"
        return u
    here = problem if begin.terms is None else with_terms(problem, begin.terms)
    zero = jnp.zeros(())
    values = begin.tangent
    known = None if values is None else Linearised(zero, values, zero, zero, zero, zero)
    return follow(problem, Start(u, here, known), log)


def _outcome(call: Solve, u: np.ndarray, log: Log) -> Outcome:
    stats = log.stats()
    done = stats.steps[-1].fraction if stats.steps else 0.0
    counts = np.array([bool(log.reason), done, stats.iterations, stats.cuts], u.dtype)
    tangent = np.zeros(call.num_values, u.dtype)
    if call.num_values and not log.reason:
        tangent = log.end.tangent.values  # type: ignore[union-attr]
    return Outcome(jnp.asarray(u), jnp.asarray(counts), jnp.asarray(tangent))


def _lanes_on_host(leaves, call: Solve, lead, batched) -> list[jax.Array]:
    """Every lane with its own record; lanes from rest help one another."""
    num = int(np.prod(lead))
    rows = [
        np.asarray(x).reshape(num, *x.shape[len(lead) :]) if b else x
        for x, b in zip(leaves, batched, strict=True)
    ]

    def lane(k: int) -> tuple[Problem, Begin | None]:
        one = [jnp.asarray(x[k]) if b else x for x, b in zip(rows, batched, strict=True)]
        return call.inputs(one)

    logs = [Log(*call.settings) for _ in range(num)]
    call.logs[:] = logs
    if call.inputs(leaves)[1] is None:
        varying = [x for x, b in zip(rows, batched, strict=True) if b and x.dtype.kind == "f"]
        body = call.inputs(list(batched))[0]
        shape = jax.tree.leaves((body.mesh, body.kinematics, body.formulation))
        same_body = not any(leaf is True for leaf in shape)
        features = scaled_features(varying)
        answers = solve_lanes(lambda k: lane(k)[0], features, logs, same_body)
    else:
        answers = [_follow(*lane(k), logs[k]) for k in range(num)]
    outcomes = [_outcome(call, u, log) for u, log in zip(answers, logs, strict=True)]
    stacked = [jnp.stack(column) for column in zip(*outcomes, strict=True)]
    return [x.reshape(*lead, *x.shape[1:]) for x in stacked]


@_equilibrium_p.def_abstract_eval
def _shapes(*leaves, call: Solve, lead, batched):
    dtype = jnp.result_type(float)
    shapes = (call.shape, (4,), (call.num_values,))
    return [jax.core.ShapedArray((*lead, *shape), dtype) for shape in shapes]


def _batch(leaves, axes, *, call: Solve, lead, batched):
    """One more leading axis: arrays that have any of the axes get all of them."""
    sizes = [x.shape[a] for x, a in zip(leaves, axes, strict=True) if a is not None]
    wide = (sizes[0], *lead)
    rows = []
    for x, axis, before in zip(leaves, axes, batched, strict=True):
        if axis is not None:
            x = jnp.moveaxis(x, axis, 0)
            if not before and lead:
                x = x.reshape(x.shape[0], *(1 for _ in lead), *x.shape[1:])
        if axis is not None or before:
            own = x.shape[len(wide) :] if axis is not None else x.shape[len(lead) :]
            x = jnp.broadcast_to(x, (*wide, *own))
        rows.append(x)
    batched = tuple(b or a is not None for a, b in zip(axes, batched, strict=True))
    out = _equilibrium_p.bind(*rows, call=call, lead=wide, batched=batched)
    return out, [0] * len(out)


batching.primitive_batchers[_equilibrium_p] = _batch


def _in_trace(*leaves, call: Solve, lead, batched) -> list[Any]:
    """The loop of `traced`; lanes run one after another, so that none waits for the slowest."""
    # hidden from constant folding, which takes seconds on index arrays
    leaves = jax.lax.optimization_barrier(leaves)

    def one(leaves):
        problem, begin = call.inputs(leaves)
        u, counts, tangent = follow_traced(problem, begin, *call.settings)
        return u, counts, tangent[: call.num_values]

    if not lead:
        return list(one(leaves))
    num = int(np.prod(lead))
    rows = [x for x, b in zip(leaves, batched, strict=True) if b]

    def lane(row):
        row = iter(row)
        return one([next(row) if b else x for x, b in zip(leaves, batched, strict=True)])

    out = jax.lax.map(lane, [x.reshape(num, *x.shape[len(lead) :]) for x in rows])
    return [x.reshape(*lead, *x.shape[1:]) for x in out]


mlir.register_lowering(_equilibrium_p, mlir.lower_fun(_in_trace, multiple_results=True))
