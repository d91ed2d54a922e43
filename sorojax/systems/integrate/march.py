"""Fixed steps of one block between instants: runs whose cost is known beforehand."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from sorojax._jax.programs import split
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
    state, unravel, rate = rate_of(method, block, inputs, state)
    move, short = interval_of(substeps // parts), interval / parts
    if memory is None:
        memory = move.begin((method, rate, time[0], state), short)
    plan = passes(count * parts, substeps * count, judged)

    def advance(run: Doubled, one_pass):
        number, part, first, length = one_pass
        walk, h = run.begin(part), length * short
        t = time[number // parts] + first * short
        given = (method, rate, t, walk.state, walk.memory)
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


def as_tree(unravel: Unravel, state: PyTree) -> PyTree:
    """A state that `rate_of` gave as the tree that it was."""
    return state if unravel is None else unravel(state)


def as_trees(unravel: Unravel, states: PyTree) -> PyTree:
    """The same of states with a leading axis of time."""
    return states if unravel is None else jax.vmap(unravel)(states)


class Rate(eqx.Module):
    """The rate of a block under inputs, for methods that may look at the block."""

    block: AbstractBlock
    inputs: Mapping[str, Any]

    def __call__(self, t, state):
        return self.block.vector_field(t, state, at_time(self.inputs, t))

    def under(self, held: Mapping[str, Any]) -> "Rate":
        """The same under commands that are held."""
        return Rate(self.block, {**self.inputs, **held})


class VectorRate(eqx.Module):
    """The rate of a state that is one vector; what a run does not change is computed before."""

    remainder: Callable[..., Array] = eqx.field(static=True)
    constants: PyTree
    held: Mapping[str, Any]

    def __call__(self, t, state):
        return self.remainder(self.constants, jnp.asarray(t, state.dtype), state, self.held)

    def under(self, held: Mapping[str, Any]) -> "VectorRate":
        """The same under commands that are held."""
        return VectorRate(self.remainder, self.constants, held)


def rate_of(
    method: AbstractMethod,
    block: AbstractBlock,
    inputs: Mapping[str, Any],
    state: PyTree,
    held: Mapping[str, Any] | None = None,
) -> tuple[PyTree, Unravel, Any]:
    """The state as `method` takes it in a run, what makes it a tree again, and its rate, which
    may be asked for `under` commands like those in `held`."""
    held = {} if held is None else held
    plain = Rate(block, inputs)
    if not (method.takes_vector and jax.tree.leaves(state)):
        return state, None, plain.under(held)
    flat, unravel = ravel_pytree(state)

    def rate(t, x, held):
        return ravel_pytree(plain.under(held)(t, unravel(x)))[0]

    constants, remainder = split(rate, jnp.zeros((), flat.dtype), flat, held)
    return flat, unravel, VectorRate(remainder, constants, held)


class interval_of(eqx.Module):
    """Moves a state by a number of steps that share an interval."""

    substeps: int = eqx.field(static=True)

    def begin(self, given, interval):
        """The memory of the method through the whole run, if it has one."""
        method, rate, t, state = given
        if not (method.keeps or method.carries):
            return None
        return method.begin(rate, t, state, interval / self.substeps)

    def taken(self, given, interval) -> tuple[PyTree, Any, Array]:
        """State, memory and whether all went well, with derivatives wherever it ends."""
        method, *_, memory = given
        if method.carries:
            return self(given, interval)
        new, _, converged = guarded(self, given, interval)
        return new, memory, converged

    def __call__(self, given, interval):
        method, rate, t, state, memory = given
        return repeated(method, rate, t, state, interval / self.substeps, self.substeps, memory)
