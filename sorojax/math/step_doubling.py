"""Whether the steps of a run are short enough: a few of them made again as two halves.

A run of fixed steps is a scan over its rows, of one or more steps each. Of some rows the scan
makes two more passes, from the same state by steps of half the length. Their distance from the
rows is the error of these rows; a run whose errors add up to as much as its motion is
unstable.

Reference:
    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, 1993, section II.4,
    for the estimate by step doubling.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from sorojax.math.status import Status

_FEWEST_ROWS = 160  # where a run has as many steps, so that checks cost a twentieth at most
_ROWS_PER_CHECK = 80
_FEWEST_STEPS = 8  # of a run that is judged
_LIMIT = 0.7  # of the motion
_COARSE = 0.4  # of what a row moved: then errors no longer follow the order of a method
_ROUNDING = 0.6  # power of the unit roundoff: what two ways of a step may differ by


class Passes(NamedTuple):
    """What a scan makes, in order.

    Attributes:
        row: Number of the row.
        part: 0 the whole row, 1 its first half again, 2 its second half again.
    """

    row: np.ndarray
    part: np.ndarray

    @property
    def length(self) -> np.ndarray:
        """Length of the steps, of those of the run."""
        return np.where(self.part == 0, 1.0, 0.5)

    @property
    def start(self) -> np.ndarray:
        """Where a pass begins, in rows."""
        return self.row + np.where(self.part == 2, 0.5, 0.0)


class Doubled(NamedTuple):
    """The state of a run that repeats some of its rows: now, before the last row, and in the
    middle of the row that is being repeated."""

    now: PyTree
    before: PyTree
    middle: PyTree

    @classmethod
    def at(cls, state: PyTree) -> "Doubled":
        """A run that begins."""
        return cls(state, state, state)

    def begin(self, part: Array) -> PyTree:
        """What a pass starts from."""
        before, middle = jax.lax.stop_gradient((self.before, self.middle))
        again = _where(part == 1, before, middle)
        return _where(part == 0, self.now, again)

    def end(self, part: Array, begun: PyTree, new: PyTree) -> "Doubled":
        """The same after a pass from `begun` to `new`."""
        whole = part == 0
        return Doubled(_where(whole, new, self.now), _where(whole, begun, self.before), new)


def rows_between(saves: int, every: int, judged: bool) -> int:
    """Rows into which the `every` steps between two saved states are divided."""
    steps = saves * every
    if not judged or saves >= _FEWEST_ROWS or steps < _FEWEST_STEPS:
        return 1
    wanted = min(_FEWEST_ROWS, steps)
    return next(r for r in range(1, every + 1) if every % r == 0 and saves * r >= wanted)


def passes(rows: int, steps: int, judged: bool) -> Passes:
    """The passes of a run of `rows` rows: every row, and those that are judged once more."""
    row, part = np.arange(rows, dtype=np.int32), np.zeros(rows, np.int32)
    if judged and steps >= _FEWEST_STEPS:
        count = 2 + rows // _ROWS_PER_CHECK
        again = np.unique(np.linspace(0, rows - 1, min(count, rows)).round().astype(np.int32))
        row = np.concatenate([row, again, again])
        part = np.concatenate([part, np.ones_like(again), np.full_like(again, 2)])
        order = np.lexsort((part, row))
        row, part = row[order], part[order]
    return Passes(row, part)


def rows_too_long(plan: Passes, path: list[Array], states: list[Array]) -> Bool[Array, ""]:
    """Whether the steps of a run are too long.

    Args:
        plan: The passes that were made.
        path: Positions at the ends of all rows, the start included.
        states: Positions at the end of every pass; of those of whole rows none is read.
    """
    again = np.flatnonzero(plan.part == 2)
    if len(again) == 0 or not path:
        return jnp.array(False)
    rows = plan.row[again]
    flags = [_too_long(x, y[again], rows) for x, y in zip(path, states, strict=True)]
    return jnp.any(jnp.stack(flags))


def whole_rows(plan: Passes, states: PyTree) -> PyTree:
    """What was stacked over all passes, for those of whole rows."""
    whole = np.flatnonzero(plan.part == 0)
    if len(whole) == len(plan.part):
        return states
    return jax.tree.map(lambda b: b[whole], states)


def after_start(start: PyTree, states: PyTree) -> PyTree:
    """A first state and the states after it, stacked."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, states)


def positions(state: PyTree) -> list[Array]:
    """The arrays of a state by which a run is judged: without integers, and without the `v`
    that stands beside a `q`, `u` or `x` as the rate of those. A mode that a step passes over
    has a rate that is all wrong and hardly any share in the motion."""
    found = []
    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    names = {jax.tree_util.keystr(path) for path, _ in leaves}
    for path, leaf in leaves:
        *above, last = path or (None,)
        beside = [(*above, jax.tree_util.DictKey(key)) for key in ("q", "u", "x")]
        rate = last == jax.tree_util.DictKey("v")
        if rate and any(jax.tree_util.keystr(tuple(p)) in names for p in beside):
            continue
        if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact):
            found.append(leaf)
    return found


def judged_status(status: Status, too_long: Bool[Array, ""]) -> Status:
    """`unstable` for a run that ended well by steps that are too long."""
    return Status.where((status == Status.successful) & too_long, Status.unstable, status)


def _too_long(path: Array, repeated: Array, rows: np.ndarray) -> Bool[Array, ""]:
    """Whether the errors of all rows add up to as much as the largest distance from the start.

    Between two rows that were repeated the error changes as an exponential function would.
    """
    path, repeated = jax.lax.stop_gradient((path, repeated))
    x, y = path.reshape(len(path), -1), repeated.reshape(len(rows), -1)
    noise = float(jnp.finfo(x.dtype).eps) ** _ROUNDING * jnp.max(jnp.abs(x), initial=0.0)
    error = jnp.maximum(_sizes(y - x[rows + 1]) - noise, 0.0)
    between = (np.diff(rows) - 1).astype(error.dtype)
    sum_of_errors = jnp.sum(error) + jnp.sum(_means(error) * between)
    seen = jnp.sum(_sizes(x[rows + 1] - x[rows]))
    limit = jnp.where(jnp.sum(error) > _COARSE * seen, _COARSE, _LIMIT)
    return sum_of_errors > limit * jnp.max(_sizes(x - x[:1]))


def _means(values: Float[Array, " n"]) -> Float[Array, " n-1"]:
    """Logarithmic means of neighbours: of exponential functions between them."""
    low, high = jnp.minimum(values[:-1], values[1:]), jnp.maximum(values[:-1], values[1:])
    ratio = jnp.maximum(low / jnp.where(high > 0, high, 1.0), jnp.finfo(values.dtype).eps)
    apart = ratio < 0.99
    slope = (1 - ratio) / -jnp.log(jnp.where(apart, ratio, 0.5))
    return high * jnp.where(apart, slope, 1.0)


def _sizes(rows: Float[Array, "rows n"]) -> Float[Array, " rows"]:
    """Largest entry of every row: it cannot overflow where no entry does."""
    return jnp.max(jnp.abs(rows), axis=1, initial=0.0)


def _where(condition: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
