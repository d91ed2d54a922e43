"""Fixed steps of one block between instants: runs whose cost is known beforehand."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
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
from sorojax.systems.integrate.integrate import Integration, explicit_inputs
from sorojax.systems.network import at_time

#: Makes a tree of a state that is one vector; None where it is a tree.
Unravel = Callable[[Array], PyTree] | None


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
) -> Integration:
    """Run by `substeps` steps in every interval between saved instants; if `judged`, ends as
    `unstable` where the steps were too long (`math.ode.step_control`)."""
    inputs = explicit_inputs(inputs, time[0])
    count = time.shape[0] - 1
    judged = judged and not method.carries
    parts = rows_between(count, substeps, judged)
    state, unravel = as_vector(method, state)
    move, short = interval_of(substeps // parts, unravel), interval / parts
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
        return run.end(part, new), new.state

    if method.carries:  # a step is large beside what it starts from
        advance = jax.checkpoint(advance, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]
    start = Walk(state, memory, finite(state), jnp.array(True), time[0])
    within = plan.start - plan.row // parts * parts
    made = (
        plan.row,
        plan.part,
        within.astype(interval.dtype),
        plan.length.astype(interval.dtype),
    )
    run, states = jax.lax.scan(advance, Doubled.at(start), made)
    end = run.now
    path = as_trees(unravel, after_start(state, whole_rows(plan, states)))
    states = as_trees(unravel, states)
    too_long = rows_too_long(plan, positions(path), positions(states))
    path = jax.tree.map(lambda a: a[::parts], path)
    steps = jnp.asarray(substeps * count)
    none = jnp.zeros(0, bool)
    return Integration(
        path,
        as_tree(unravel, end.state),
        end.reached,
        judged_status(end.status, too_long),
        steps,
        jnp.zeros_like(steps),
        none,
        None,
        end.memory,
    )


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
        """The output of an interval after one that failed."""
        return self.state, self.memory, self.solved

    @property
    def status(self) -> Status:
        failed = Status.where(self.solved, Status.not_finite, Status.not_converged)
        return Status.where(self.good, Status.successful, failed)


def as_vector(method: AbstractMethod, state: PyTree) -> tuple[PyTree, Unravel]:
    """The state as `method` takes it in a run, and what makes it a tree again."""
    if method.takes_vector and jax.tree.leaves(state):
        return ravel_pytree(state)
    return state, None


def as_tree(unravel: Unravel, state: PyTree) -> PyTree:
    """A state that `as_vector` gave as the tree that it was."""
    return state if unravel is None else unravel(state)


def as_trees(unravel: Unravel, states: PyTree) -> PyTree:
    """The same of states with a leading axis of time."""
    return states if unravel is None else jax.vmap(unravel)(states)


class Rate(eqx.Module):
    """The rate of a block under inputs, for methods that may look at the block; of a state
    that is one vector if there is an `unravel`."""

    block: AbstractBlock
    inputs: Mapping[str, Any]
    unravel: Unravel = eqx.field(static=True, default=None)

    def __call__(self, t, state):
        tree = as_tree(self.unravel, state)
        rate = self.block.vector_field(t, tree, at_time(self.inputs, t))
        return rate if self.unravel is None else ravel_pytree(rate)[0]


class interval_of(eqx.Module):
    """Moves a state by a number of steps that share an interval."""

    substeps: int = eqx.field(static=True)
    unravel: Unravel = eqx.field(static=True, default=None)

    def begin(self, given, interval):
        """The memory of the method through the whole run, if it has one."""
        method, block, inputs, t, state = given
        if not (method.keeps or method.carries):
            return None
        rate = Rate(block, inputs, self.unravel)
        return method.begin(rate, t, state, interval / self.substeps)

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
        rate = Rate(block, inputs, self.unravel)
        return repeated(method, rate, t, state, h, self.substeps, memory)
