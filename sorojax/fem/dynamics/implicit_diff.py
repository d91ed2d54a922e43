"""Motion as one differentiable operation of the numbers of its dynamics.

With concrete numbers it steps on the host, one batch member after another under `vmap`; inside
a trace it is the compiled loop of `jit`. Its derivative is that of the discrete equations,
step by step with the exact tangent at each solved displacement: one assembly, one factor and
one back-substitution for each direction. In reverse the solved displacements are the
checkpoints.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from sorojax._jax.operations import Rules, operation
from sorojax._jax.trace_state import evaluated_now
from sorojax.fem.dynamics.host import Control, Run
from sorojax.fem.dynamics.jit import Record, interval_of, run_traced
from sorojax.fem.dynamics.step import Dynamics, begin_step, end_step, matter, with_terms
from sorojax.fem.equilibrium.implicit_diff import lane_after_lane, widened
from sorojax.fem.equilibrium.jit import prepare_traced
from sorojax.fem.equilibrium.linear import linearise
from sorojax.fem.problem import residual
from sorojax.fem.supports import known_values
from sorojax.math.linalg import sparse


class MotionCall:
    """A run as data; compared by identity, so it may be a parameter."""

    def __init__(self, dynamics: Dynamics, control: Control, grid: int, rows: int):
        arrays, self._static = eqx.partition(dynamics, eqx.is_array)
        leaves, self._tree = jax.tree.flatten(arrays)
        self.leaves = [jnp.asarray(leaf, leaf.dtype) for leaf in leaves]
        self.control, self.grid, self.rows = control, grid, rows
        self.shape = dynamics.problem.mesh.points.shape

    def dynamics(self, leaves) -> Dynamics:
        return eqx.combine(jax.tree.unflatten(self._tree, leaves), self._static)

    def moving(self, leaves, dots) -> tuple[Dynamics, Dynamics, Dynamics]:
        """The numbers that move, all else, and how they move."""
        moves = [not isinstance(dot, SymbolicZero) for dot in dots]

        def pick(values, wanted):
            kept = [x if m == wanted else None for x, m in zip(values, moves, strict=True)]
            return jax.tree.unflatten(self._tree, kept)

        rest = eqx.combine(pick(leaves, False), self._static)
        return pick(leaves, True), rest, pick(dots, True)


def recorded(call: MotionCall) -> Record:
    """The run of `call`."""
    return Record(*_recorded(call, call.leaves))


def _bound(call: MotionCall, leaves):
    batched = (False,) * len(leaves)
    return tuple(_motion_of(*leaves, call=call, lead=(), batched=batched))


_recorded = jax.custom_jvp(_bound, nondiff_argnums=(0,))


def _derivative(call: MotionCall, primals, tangents):
    (leaves,), (dots,) = primals, tangents
    if call.dynamics(leaves).conserves:
        raise ValueError(
            "fem.simulate: a motion by EnergyMomentum() has no derivative. Use "
            "GeneralisedAlpha(rho_inf) or Newmark() to differentiate."
        )
    u, steps, counts = _recorded(call, leaves)
    u_dot = _linear_motion(*call.moving(leaves, dots), u, steps)
    valid = jnp.where(counts[0] == 0, jnp.ones_like(counts[0]), jnp.nan)
    return (u, steps, counts), (u_dot * valid, 0 * steps, 0 * counts)


_recorded.defjvp(_derivative, symbolic_zeros=True)


@eqx.filter_jit
def _linear_motion(params: Dynamics, rest: Dynamics, params_dot: Dynamics, u, steps) -> Array:
    """How the solved displacements move with the numbers of the dynamics."""

    def full(params) -> Dynamics:
        return eqx.combine(params, rest)

    dynamics = full(params)
    problem = dynamics.problem
    prepared = prepare_traced(problem)
    known, known_dot = jax.jvp(lambda p: matter(full(p)), (params,), (params_dot,))

    def start(params):
        return eqx.filter(full(params).start, eqx.is_inexact_array)

    first, first_dot = jax.jvp(start, (params,), (params_dot,))
    fixed = eqx.filter(dynamics.start, eqx.is_inexact_array, inverse=True)

    def advance(carry, row):
        w, entry = row
        interval, taken = interval_of(entry)

        def begun(params, known, state):
            state = eqx.combine(state, fixed)
            step = begin_step(full(params), known, state, interval)
            return eqx.partition(step, eqx.is_inexact_array)

        def unbalanced(params, step, w):
            return residual(with_terms(full(params).problem, step.terms), w).ravel()

        def ended(params, known, state, step, w):
            state = eqx.combine(state, fixed)
            new = end_step(full(params), known, state, interval, step, w)
            return eqx.filter(new, eqx.is_inexact_array)

        def live(carry):
            state, dot = carry
            at, along = (params, known, state), (params_dot, known_dot, dot)
            step, step_dot, others = jax.jvp(begun, at, along, has_aux=True)

            def whole(step):
                return eqx.combine(step, others)

            def held(step):
                return known_values(whole(step).terms[1], *w.shape)

            _, move = jax.jvp(held, (step,), (step_dot,))
            move = move.reshape(w.shape)
            _, rhs = jax.jvp(
                lambda params, step, w: unbalanced(params, whole(step), w),
                (params, step, w),
                (params_dot, step_dot, move),
            )
            here = with_terms(problem, whole(step).terms)
            values = linearise(here, prepared, w, w).values
            matrix = sparse.fix(problem.space.system, values, prepared.known)
            rhs = jnp.where(prepared.known, jnp.zeros_like(rhs), -rhs)
            found = sparse.solve(problem.space.system, matrix, rhs)
            w_dot = found.reshape(w.shape) + move
            after = jax.jvp(
                lambda params, known, state, step, w: ended(
                    params, known, state, whole(step), w
                ),
                (*at, step, w),
                (*along, step_dot, w_dot),
            )
            return after, w_dot

        return jax.lax.cond(taken, live, lambda carry: (carry, jnp.zeros_like(w)), carry)

    _, dots = jax.lax.scan(
        jax.checkpoint(advance, prevent_cse=False),  # pyright: ignore[reportPrivateImportUsage]
        (first, first_dot),
        (u, steps),
    )
    return dots


def _on_host(*leaves, call: MotionCall, lead: tuple[int, ...], batched: tuple[bool, ...]):
    with evaluated_now():
        if not lead:
            return list(_run(call, list(leaves)))
        num = int(np.prod(lead))
        rows = [
            np.asarray(x).reshape(num, *x.shape[len(lead) :]) if b else x
            for x, b in zip(leaves, batched, strict=True)
        ]
        found = []
        for k in range(num):
            one = zip(rows, batched, strict=True)
            found.append(_run(call, [jnp.asarray(x[k]) if b else x for x, b in one]))
        stacked = [jnp.stack(column) for column in zip(*found, strict=True)]
        return [x.reshape(*lead, *x.shape[1:]) for x in stacked]


def _run(call: MotionCall, leaves) -> Record:
    run = Run(call.dynamics(leaves), call.control)
    for index in range(call.grid):
        if not run.advance(index):
            break
    u = np.zeros((call.rows, *call.shape))
    steps = np.zeros((call.rows, 3))
    for row, (index, begin, end, w) in enumerate(run.rows):
        u[row], steps[row] = w, (index, begin, end)
    counts = (bool(run.reason), run.steps, run.iterations, run.cuts)
    return Record(*map(jnp.asarray, (u, steps, np.array(counts, float))))


def _shapes(*leaves, call: MotionCall, lead, batched):
    dtype = jnp.result_type(float)
    shapes = ((call.rows, *call.shape), (call.rows, 3), (4,))
    return [jax.ShapeDtypeStruct((*lead, *shape), dtype) for shape in shapes]


def _in_trace(*leaves, call: MotionCall, lead, batched) -> list[Any]:
    """The loop of `dynamics_traced`, lane after lane."""
    leaves = jax.lax.optimization_barrier(leaves)  # hidden from constant folding

    def one(leaves):
        return list(run_traced(call.dynamics(leaves), call.control, call.grid, call.rows))

    return lane_after_lane(one, leaves, lead, batched)


def _batch(leaves, axes, *, call, lead, batched):
    rows, wide, batched = widened(leaves, axes, lead, batched)
    return _motion_of(*rows, call=call, lead=wide, batched=batched)


_motion_of = operation("fem_motion", Rules(_on_host, _in_trace, _shapes, _batch))
