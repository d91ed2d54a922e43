"""Fixed steps of one block between instants: runs whose cost is known beforehand."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from sorojax.math.host import tell
from sorojax.math.ode.explicit import AbstractMethod, finite, guarded, repeated
from sorojax.math.ode.step_control import (
    Doubled,
    after_start,
    judged_status,
    passes,
    positions,
    rows_between,
    rows_too_long,
    whole_rows,
)
from sorojax.math.status import Status
from sorojax.systems.blocks.block import AbstractBlock
from sorojax.systems.integrate.integrate import Motion, explicit_inputs
from sorojax.systems.network import at_time


def fixed(
    block: AbstractBlock,
    inputs: Mapping[str, Any],
    state: PyTree,
    time: Float[Array, " time"],
    interval: Float[Array, ""],
    method: AbstractMethod,
    substeps: int,
    memory: Any = None,
    progress: bool = False,
    judged: bool = True,
) -> Motion:
    """Run by `substeps` steps in every interval between saved instants; if `judged`, ends as
    `unstable` where the steps were too long (`math.ode.step_control`)."""
    inputs = explicit_inputs(inputs, time[0])
    count = time.shape[0] - 1
    judged = judged and not method.carries
    parts = rows_between(count, substeps, judged)
    move, short = interval_of(substeps // parts), interval / parts
    if memory is None:
        memory = move.begin((method, block, inputs, time[0], state), short)
    plan = passes(count * parts, substeps * count, judged)

    def advance(run: Doubled, one_pass):
        number, part, first, length = one_pass
        walk, h = run.begin(part), length * short
        t = time[number // parts] + first * short
        given = (method, block, inputs, t, walk.state, walk.memory)
        if method.carries:  # a step is large: none is computed after one that failed
            moved = jax.lax.cond(walk.good, lambda: move.taken(given, h), lambda: walk.held)
        else:
            moved = move.taken(given, h)
        new = walk.after(moved, t + h)
        if progress:
            tell("simulate", (number + 1) / (count * parts))
        return run.end(part, walk, new), new.state

    if method.carries:  # a step is large beside what it starts from
        advance = jax.checkpoint(advance, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]
    start = Walk(state, memory, finite(state), jnp.array(True), time[0])
    within = plan.start - plan.row // parts * parts
    made = (
        plan.row, plan.part, within.astype(interval.dtype), plan.length.astype(interval.dtype)
    )  # fmt: skip
    run, states = jax.lax.scan(advance, Doubled.at(start), made)
    end = run.now
    path = after_start(state, whole_rows(plan, states))
    too_long = rows_too_long(plan, positions(path), positions(states))
    path = jax.tree.map(lambda a: a[::parts], path)
    steps = jnp.asarray(substeps * count)
    none = jnp.zeros(0, bool)
    return Motion(
        path, end.state, end.reached, judged_status(end.status, too_long), steps,
        jnp.zeros_like(steps), none, None, end.memory,
    )  # fmt: skip


class Walk(NamedTuple):
    """A run of fixed steps on its way: all well so far, every equation solved, and until
    when [s]."""

    state: PyTree
    memory: Any
    good: Bool[Array, ""]
    solved: Bool[Array, ""]
    reached: Float[Array, ""]

    def after(self, moved: tuple[PyTree, Any, Array], t) -> "Walk":
        """The same after an interval that ends at `t`, or held where it failed."""
        new, memory, converged = moved
        solved = self.solved & converged
        good = self.good & solved & finite(new)
        state, memory = jax.tree.map(
            lambda a, b: jnp.where(good, a, b), (new, memory), (self.state, self.memory)
        )
        return Walk(state, memory, good, solved, jnp.where(good, t, self.reached))

    @property
    def held(self) -> tuple[PyTree, Any, Array]:
        """What an interval yields after one that failed."""
        return self.state, self.memory, self.solved

    @property
    def status(self) -> Status:
        failed = Status.where(self.solved, Status.not_finite, Status.not_converged)
        return Status.where(self.good, Status.successful, failed)


class Rate(eqx.Module):
    """The rate of a block under inputs, for methods that may look at the block."""

    block: AbstractBlock
    inputs: Mapping[str, Any]

    def __call__(self, t, state):
        return self.block.vector_field(t, state, at_time(self.inputs, t))


class interval_of(eqx.Module):
    """Moves a state by a number of steps that share an interval."""

    substeps: int = eqx.field(static=True)

    def begin(self, given, interval):
        """What the method keeps or carries through the whole run, if it does."""
        method, block, inputs, t, state = given
        if not (method.keeps or method.carries):
            return None
        return method.begin(Rate(block, inputs), t, state, interval / self.substeps)

    def taken(self, given, interval) -> tuple[PyTree, Any, Array]:
        """State, memory and whether all went well, with derivatives wherever it ends."""
        method, *_, memory = given
        if method.carries:
            return self(given, interval)
        new, _, converged = guarded(self, given, interval)
        return new, memory, converged

    def __call__(self, given, interval):
        method, block, inputs, t, state, memory = given
        h = interval / self.substeps
        return repeated(method, Rate(block, inputs), t, state, h, self.substeps, memory)
