"""One solve as data: its arrays, all that is no array, and the record of how it went."""

import copy

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from sorojax._jax.trace_state import is_tracer
from sorojax.fem.follow import Log, Stats
from sorojax.fem.newton import Newton
from sorojax.fem.problem import Problem
from sorojax.fem.traced import Begin


class _Record:
    """What the host found: one log per solve, lanes in row-major order; none in a trace.
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

        What stays is left out of the derivative, so that it costs nothing.
        """
        count = self.num_problem_leaves
        moved = {
            k: dot for k, dot in zip(self.traced, dots, strict=True)
            if k < count and not isinstance(dot, SymbolicZero)
        }  # fmt: skip
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
