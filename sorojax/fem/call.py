"""One solve as data: its arrays, all that is no array, and the record of how it went."""

import copy

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from sorojax._types import is_traced
from sorojax.fem.follow import Log, Stats
from sorojax.fem.newton import Newton
from sorojax.fem.problem import Problem
from sorojax.fem.traced import Begin


class _Record:
    """What the host found: one log per solve, lanes in row-major order; none in a trace."""

    def __init__(self):
        self.logs: list[Log] = []
        self.batched = False

    def keep(self, logs: list[Log], batched: bool) -> None:
        self.logs, self.batched = logs, batched


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
        arrays, self._static = eqx.partition((problem, begin), eqx.is_array)
        leaves, self._tree = jax.tree.flatten(arrays)
        self.leaves = [_strong(leaf) for leaf in leaves]
        self.traced = [k for k, leaf in enumerate(self.leaves) if is_traced(leaf)]
        self.num_problem_leaves = len(jax.tree.leaves(eqx.filter(problem, eqx.is_array)))
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
        return eqx.combine(jax.tree.unflatten(self._tree, leaves), self._static)

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
        all_leaves = range(len(leaves))

        def problem(values) -> Problem:
            return jax.tree.unflatten(self._tree, values)[0]

        rest = [leaves[k] if k < count and k not in moved else None for k in all_leaves]
        params = [leaves[k] if k in moved else None for k in all_leaves]
        rates = [moved.get(k) for k in all_leaves]
        return problem(params), eqx.combine(problem(rest), self._static[0]), problem(rates)

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
