"""A motion inside a trace: the step rules of `host` as one compiled loop, and its replay.

All states follow by sums from the displacements that the steps solved for, so only these are
kept for a derivative.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sorojax.fem.assembly import assemble as asm
from sorojax.fem.dynamics.host import Control, ended
from sorojax.fem.dynamics.step import (
    Dynamics,
    Interval,
    Matter,
    State,
    begin_step,
    end_step,
    matter,
    with_terms,
)
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.jit import Begin, follow_traced, prepare_traced
from sorojax.fem.equilibrium.linear import Prepared
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
        fine = fine & rules.error_fits(ratio)
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


@eqx.filter_jit
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
