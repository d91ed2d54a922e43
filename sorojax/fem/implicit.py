"""Equilibrium as a function of the numbers of a problem, for every transformation.

One operation stands for the solve. With concrete numbers it follows the load path on the
host, lane after lane under `vmap`; inside a trace it becomes the loop of `traced`. Its
derivative is that of the implicit function (`response`).
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from sorojax._jax.operations import Rules, operation
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax.fem.call import Solve
from sorojax.fem.follow import Log, Start, begin_at, follow
from sorojax.fem.lanes import scaled_features, solve_lanes
from sorojax.fem.linear import Linearised, linearise
from sorojax.fem.problem import Problem
from sorojax.fem.response import Equilibrium, response, response_at_once
from sorojax.fem.traced import (
    Begin,
    Outcome,
    follow_traced,
    prepare_traced,
    with_terms,
)

#: Last relative update below which the tangent assembled before it is as good as exact.
_SHARP = 1e-5


def equilibrium(call: Solve) -> Outcome:
    """Equilibrium of the problem of `call`; the host's record of it is in `call` then."""
    return Outcome(*_equilibrium(call, [call.leaves[k] for k in call.traced]))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _equilibrium(call: Solve, traced):
    return _solved(call, traced)


def _solved(call: Solve, traced):
    leaves = call.complete(traced)
    batched = (False,) * len(leaves)
    return tuple(_equilibrium_of(*leaves, call=call, lead=(), batched=batched))


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
    return (u, counts, values), (u_dot, _still(counts), _still(values))


def _still(x) -> SymbolicZero:
    return SymbolicZero(jax.typeof(x).to_tangent_aval())


_equilibrium.defjvp(_derivative, symbolic_zeros=True)


def _linearised_at(call: Solve, traced, dots, u, counts, values):
    """What makes du of R(u, params) = 0, with prescribed displacements moving along."""
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


def _on_host(*leaves, call: Solve, lead: tuple[int, ...], batched: tuple[bool, ...]):
    with evaluated_now():
        if lead:
            return _lanes_on_host(leaves, call, lead, batched)
        log = Log(*call.settings)
        call.record.keep([log], False)
        u = call.record.displacement = _follow(*call.inputs(leaves), log)
        return _outcome(call, u, log)


def _follow(problem: Problem, begin: Begin | None, log: Log) -> np.ndarray:
    if begin is None:
        return follow(problem, begin_at(problem, None), log)
    u = np.asarray(begin.u)
    if not np.all(np.isfinite(u)):
        log.reason = "the state to start from is no equilibrium"
        return u
    zero = jnp.zeros(())
    values = begin.tangent
    known = None if values is None else Linearised(zero, values, zero, zero, zero, zero)
    if begin.terms is not None:
        return follow(problem, Start(u, with_terms(problem, begin.terms), known), log)
    return _from_guess(problem, Start(u, problem, known), log)


def _from_guess(problem: Problem, guess: Start, log: Log) -> np.ndarray:
    """Newton from a guess at full load; from rest along the load if it is too far away."""
    once = Log(log.newton, 1, 0)
    u = follow(problem, guess, once)
    if once.reason:
        return follow(problem, begin_at(problem, None), log)
    log.steps, log.end = once.steps, once.end
    return u


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
    call.record.keep(logs, True)
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


def _shapes(*leaves, call: Solve, lead, batched):
    dtype = jnp.result_type(float)
    shapes = (call.shape, (4,), (call.num_values,))
    return [jax.ShapeDtypeStruct((*lead, *shape), dtype) for shape in shapes]


def _batch(leaves, axes, *, call: Solve, lead, batched):
    rows, wide, batched = widened(leaves, axes, lead, batched)
    return _equilibrium_of(*rows, call=call, lead=wide, batched=batched)


def widened(leaves, axes, lead: tuple[int, ...], batched: tuple[bool, ...]):
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
    return rows, wide, tuple(b or a is not None for a, b in zip(axes, batched, strict=True))


def _in_trace(*leaves, call: Solve, lead, batched) -> list[Any]:
    """The loop of `traced`; lanes run one after another, so that none waits for the slowest."""
    # hidden from constant folding, which takes seconds on index arrays
    leaves = jax.lax.optimization_barrier(leaves)

    def one(leaves):
        problem, begin = call.inputs(leaves)
        u, counts, tangent = follow_traced(problem, begin, *call.settings)
        return u, counts, tangent[: call.num_values]

    return lane_after_lane(one, leaves, lead, batched)


def lane_after_lane(one, leaves, lead: tuple[int, ...], batched) -> list[Any]:
    """`one(leaves)` for every lane of the leading axes `lead`, inside a trace."""
    if not lead:
        return list(one(list(leaves)))
    num = int(np.prod(lead))
    rows = [x for x, b in zip(leaves, batched, strict=True) if b]

    def lane(row):
        row = iter(row)
        return one([next(row) if b else x for x, b in zip(leaves, batched, strict=True)])

    out = jax.lax.map(lane, [x.reshape(num, *x.shape[len(lead) :]) for x in rows])
    return [x.reshape(*lead, *x.shape[1:]) for x in out]


_equilibrium_of = operation("fem_equilibrium", Rules(_on_host, _in_trace, _shapes, _batch))
