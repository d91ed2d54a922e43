"""Motion as one differentiable operation of the numbers of its dynamics.

With concrete numbers it steps on the host, one batch member after another under `vmap`; inside
a trace it is the compiled loop of `jit`. Its derivative is that of the discrete equations,
step by step with the exact tangent at each solved displacement: one assembly, one factor and
one back-substitution for each direction. In reverse the solved displacements are the
checkpoints.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.jit import once
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.dynamics.host import Control, Run, ended
from sorojax.fem.dynamics.step import (
    Dynamics,
    Interval,
    Matter,
    State,
    begin_step,
    end_step,
    matter,
)
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.jit import Begin, follow_traced, prepare_traced
from sorojax.fem.equilibrium.lanes import lane_operation, moving_part
from sorojax.fem.equilibrium.linear import Prepared, linearise
from sorojax.fem.problem import residual, with_terms
from sorojax.fem.supports import known_values
from sorojax.math.linalg import sparse
from sorojax.math.ode.step_control import halved, may_double


class Record(NamedTuple):
    """Rows of solved displacements with index, begin and end of their steps (begin = end in
    rows that were not needed), and as floats: failed or not, steps, iterations, cuts."""

    u: Float[Array, "rows nodes dim"]
    steps: Float[Array, "rows 3"]
    counts: Float[Array, " 4"]


class _Walk(NamedTuple):
    state: State
    index: Int[Array, ""]
    done: Float[Array, ""]
    share: Float[Array, ""]
    failures: Int[Array, ""]
    row: Int[Array, ""]
    iterations: Float[Array, ""]
    cuts: Int[Array, ""]
    u: Float[Array, "rows nodes dim"]
    steps: Float[Array, "rows 3"]
    running: Bool[Array, ""]


def run_traced(dynamics: Dynamics, control: Control, grid: int, rows: int) -> Record:
    """Step through the grid; every number may be traced."""
    known = matter(dynamics)
    prepared = prepare_traced(dynamics.problem)
    moving, rest = eqx.partition(dynamics.start, eqx.is_inexact_array)

    def one_pass(walk: _Walk) -> _Walk:
        state = eqx.combine(walk.state, rest)
        interval = Interval(walk.index, walk.done, walk.done + walk.share)
        u, new, fine, easy, count = _attempt(
            dynamics, known, prepared, control, state, interval
        )
        new = eqx.filter(new, eqx.is_inexact_array)
        return _next(walk, interval, u, new, fine, easy, count, control.max_cuts, grid, rows)

    zero = jnp.zeros((), dynamics.step.dtype)
    none = jnp.asarray(0, jnp.int32)
    shape = (rows, *dynamics.problem.mesh.points.shape)
    walk = _Walk(
        state=moving,
        index=none,
        done=zero,
        share=zero + 1,
        failures=none,
        row=none,
        iterations=zero,
        cuts=none,
        u=jnp.zeros(shape, zero.dtype),
        steps=jnp.zeros((rows, 3), zero.dtype),
        running=jnp.all(jnp.isfinite(dynamics.start.displacement)),
    )
    end = jax.lax.while_loop(lambda walk: walk.running, one_pass, walk)
    numbers = (end.index < grid, end.row, end.iterations, end.cuts)
    return Record(end.u, end.steps, jnp.stack([jnp.asarray(n, zero.dtype) for n in numbers]))


def _attempt(dynamics, known, prepared: Prepared, control: Control, state, interval):
    step = begin_step(dynamics, known, state, interval)
    problem = with_terms(dynamics.problem, step.terms)

    def solved(guess):
        found = follow_traced(
            problem, Begin(guess, step.terms), control.newton, 1, 0, prepared, moves=True
        )
        return found.u, found.counts

    start = state.displacement
    args = (problem.space, prepared.geometry, problem.kinematics, start, step.predicted - start)
    sound = rules.keeps_volume(asm.kept_volume(*args))
    u, counts = solved(jnp.where(sound, step.predicted, start))
    again = (counts[0] != 0) & sound
    u, counts = jax.lax.cond(again, lambda: solved(start), lambda: (u, counts))
    new, error, through, gained = ended(dynamics, known, state, interval, step, u)
    keeps = rules.keeps_volume(asm.kept_volume(*args[:4], new.displacement - start))
    fine, ratio = (counts[0] == 0) & ~through & ~gained & keeps, 0.0
    if control.error is not None:
        ratio = rules.error_ratio(error, control.error, new.displacement, prepared.length)
        fine = fine & (ratio <= 1.0)
    return u, new, fine, rules.is_easy(counts[2], control.newton, ratio), counts[2]


def _next(walk: _Walk, interval, u, new, fine, easy, count, max_cuts, grid, rows) -> _Walk:
    at_end, grows = interval.end >= 1.0, easy & may_double(walk.share, interval.end)
    row = jnp.minimum(walk.row, rows - 1)
    entry = jnp.stack([interval.index.astype(u.dtype), interval.begin, interval.end])
    index = walk.index + at_end.astype(jnp.int32)
    accepted = walk._replace(
        state=new,
        index=index,
        done=jnp.where(at_end, jnp.zeros_like(interval.end), interval.end),
        share=jnp.where(grows, 2 * walk.share, walk.share),
        failures=jnp.zeros_like(walk.failures),
        row=walk.row + 1,
        u=walk.u.at[row].set(u),
        steps=walk.steps.at[row].set(entry),
        running=(index < grid) & (walk.row + 1 < rows),
    )
    share, failures, running = halved(walk.share, walk.failures, max_cuts)
    cut = walk._replace(share=share, failures=failures, cuts=walk.cuts + 1, running=running)
    chosen = jax.tree.map(lambda a, b: jnp.where(fine, a, b), accepted, cut)
    return chosen._replace(iterations=walk.iterations + count)


def interval_of(entry: Float[Array, "3"]) -> tuple[Interval, Bool[Array, ""]]:
    """A step of a record, and whether it was taken; a whole step where it was not."""
    taken = entry[2] > entry[1]
    begin = jnp.where(taken, entry[1], jnp.zeros_like(entry[1]))
    end = jnp.where(taken, entry[2], jnp.ones_like(entry[2]))
    return Interval(entry[0].astype(jnp.int32), begin, end), taken


@once
def replay(dynamics: Dynamics, record: Record, grid: int, every: int) -> tuple[State, State]:
    """States at every `every`th point of the grid, NaN where the record does not reach, and
    the last state."""
    known: Matter = matter(dynamics)
    first, rest = eqx.partition(dynamics.start, eqx.is_inexact_array)

    def advance(moving, row):
        u, entry = row
        interval, taken = interval_of(entry)

        def live(moving):
            state = eqx.combine(moving, rest)
            step = begin_step(dynamics, known, state, interval)
            new = end_step(dynamics, known, state, interval, step, u)
            return eqx.filter(new, eqx.is_inexact_array)

        moving = jax.lax.cond(taken, live, lambda moving: moving, moving)
        return moving, moving

    last, after = jax.lax.scan(
        jax.checkpoint(advance, prevent_cse=False),  # pyright: ignore[reportPrivateImportUsage]
        first,
        (record.u, record.steps),
    )
    whole = jax.lax.stop_gradient(record.steps)
    # the point of the grid that a row ends at, if any
    ends = jnp.where(whole[:, 2] >= 1.0, whole[:, 0] + 1, jnp.zeros_like(whole[:, 0]))
    wanted = jnp.arange(every, grid + 1, every)
    found = ends[None, :] == wanted[:, None].astype(ends.dtype)
    where, reached = jnp.argmax(found, axis=1), jnp.any(found, axis=1)

    def pick(start, rows):
        mask = reached.reshape(-1, *(1 for _ in rows.shape[1:]))
        kept = jnp.where(mask, rows[where], jnp.nan)
        return jnp.concatenate([start[None], kept])

    states = jax.tree.map(pick, first, after)
    return eqx.combine(states, rest), eqx.combine(last, rest)


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
        parts = (jax.tree.unflatten(self._tree, x) for x in moving_part(leaves, dots))
        moving, rest, rates = parts
        return moving, eqx.combine(rest, self._static), rates


def recorded(call: MotionCall) -> Record:
    """The run of `call`."""
    return Record(*_recorded(call, call.leaves))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _recorded(call: MotionCall, leaves):
    return _motion_of(call, leaves)


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


def _in_trace(call: MotionCall, leaves) -> Record:
    return run_traced(call.dynamics(leaves), call.control, call.grid, call.rows)


_motion_of = lane_operation(
    "fem_motion",
    _run,
    lambda call, lanes: [_run(call, lanes.lane(k)) for k in range(lanes.count)],
    _in_trace,
    lambda call: ((call.rows, *call.shape), (call.rows, 3), (4,)),
)
