"""Length of time steps: proportional-integral control of adaptive runs, halving of steps that
fail, and a check of runs with fixed steps by step doubling.

The check computes some steps from the same state by two of half the length too; their
distance is the error of these steps. A run whose errors add up to as much as its motion is
unstable.

Reference:
    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, 1993, section II.4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax._types import optional_real, real
from sorojax.math.host import any_of_lanes
from sorojax.math.ode.explicit import finite
from sorojax.math.status import Status


def _tolerance(value):
    return jax.tree.map(real, value)


class Seam(NamedTuple):
    """The last step that was taken: from `state` at `time` [s] by `step` [s], with what the
    control knew before it: the error of the step before and the rejections in a row."""

    time: Float[Array, ""]
    state: PyTree
    step: Float[Array, ""]
    before: Float[Array, ""]
    rejected: Int[Array, ""]


def _paced(seam: Seam) -> Seam:
    """The state alone has derivatives: steps are chosen."""
    return jax.lax.stop_gradient(seam._replace(state=None))._replace(state=seam.state)


class _Pace(NamedTuple):
    """Memory of the control: error of the last step, rejections in a row and attempts,
    and, in a run with an `end`, the step under way and the last one taken."""

    before: Float[Array, ""]
    counts: Int[Array, " 2"]
    step: Float[Array, ""] | None
    last: Seam | None


class Control(dfx.AbstractAdaptiveStepSizeController):
    """Keeps the root mean square of error / (atol + rtol |y|) below one.

    A step that is not finite is repeated shorter; after `patience` rejections in a row the
    run ends at its last good state.

    Attributes:
        rtol: Relative tolerance; a number, or a tree of the structure of the state.
        atol: Absolute tolerance in the unit of the state; a number, or such a tree.
        max_step: Longest step [s].
        norm: For the iterations of implicit methods of diffrax.
        proportional, integral: Exponents of the control, times the order.
        patience: Rejections in a row before the run is given up.
        tries: Steps, taken and rejected, after which the run ends; unlike `max_steps` of
            diffrax it may differ between members of a batch.
        end: Time [s] past which the first step that reaches it is the last, for a run whose
            `t1` is later; steps then do not depend on where the run ends.
        first_step: Longest first step [s] of such a run.

    Reference:
        Soderlind, Automatic control and adaptive time-stepping, Numer. Algorithms 31, 2002.
    """

    rtol: PyTree[Float[Array, "..."]] = eqx.field(converter=_tolerance, default=1e-6)
    atol: PyTree[Float[Array, "..."]] = eqx.field(converter=_tolerance, default=1e-8)
    max_step: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    norm: Callable[[PyTree], Float[Array, ""]] = optx.rms_norm
    proportional: float = eqx.field(static=True, default=0.2)
    integral: float = eqx.field(static=True, default=0.6)
    patience: int = eqx.field(static=True, default=30)
    tries: Int[Array, ""] | None = None
    end: Float[Array, ""] | None = None
    first_step: Float[Array, ""] | None = None

    def wrap(self, direction):
        return self

    def to_end(self, end: Float[Array, ""], first_step: Float[Array, ""]) -> "Control":
        """The control of a run that may step past its `end`."""
        return eqx.tree_at(
            lambda c: (c.end, c.first_step),
            self,
            (end, first_step),
            is_leaf=lambda x: x is None,
        )

    def begun(self, seam: Seam) -> _Pace:
        """The memory needed to take the step of `seam` again and go on."""
        seam = _paced(seam)
        counts = jnp.stack([seam.rejected, jnp.zeros_like(seam.rejected)])
        return _Pace(seam.before, counts, seam.step, seam)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        if dt0 is None:
            limit = t1 - t0 if self.first_step is None else self.first_step
            dt0 = self._first(terms, t0, limit, y0, args, func, error_order)
        if self.max_step is not None:
            dt0 = jnp.minimum(dt0, self.max_step)
        dt0 = jax.lax.stop_gradient(dt0)
        one, none = jnp.ones_like(t0), jnp.zeros((), jnp.int32)
        pace = _Pace(one, jnp.zeros(2, jnp.int32), None, None)
        if self.end is not None:
            pace = self.begun(Seam(jnp.asarray(t0), y0, dt0, one, none))
        return t0 + dt0, pace

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        before, (rejected, made) = state.before, state.counts
        size = jax.tree.map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), y0, y1_candidate)
        ratio = jax.lax.stop_gradient(self._norm(y_error, size))
        keep = ratio < 1
        ratio = jnp.clip(
            jnp.where(jnp.isfinite(ratio), ratio, jnp.full_like(ratio, 1e30)), 1e-10
        )
        own, past = (self.integral + self.proportional, self.proportional)
        factor = 0.9 * ratio ** (-own / error_order) * before ** (past / error_order)
        wary = jnp.where(rejected > 0, jnp.ones_like(factor), jnp.full_like(factor, 10.0))
        grown = jnp.clip(factor, jnp.full_like(factor, 0.2), wary)
        cut = jnp.clip(0.9 * ratio ** (-1 / error_order), 0.1, 0.9)
        h = (t1 - t0) * jax.lax.stop_gradient(jnp.where(keep, grown, cut))
        if self.max_step is not None:
            h = jnp.minimum(h, self.max_step)
        start = jnp.where(keep, t1, t0)
        last = state.last
        if self.end is not None:
            this = Seam(t0, y0, state.step, before, rejected)
            last = jax.tree.map(lambda a, b: jnp.where(keep, a, b), this, last)
            last = _paced(last)
        rejected = jnp.where(keep, 0, rejected + 1).astype(jnp.int32)
        ended = dfx.RESULTS.where(
            (rejected > self.patience) | (start + h <= start),
            dfx.RESULTS.dt_min_reached,
            dfx.RESULTS.successful,
        )
        if self.tries is not None:
            spent = made + 1 >= self.tries
            ended = dfx.RESULTS.where(spent, dfx.RESULTS.max_steps_reached, ended)
        step = None
        if self.end is not None:
            step, over = h, keep & (t1 >= self.end) & (ended == dfx.RESULTS.successful)
            ended = dfx.RESULTS.where(over, dfx.RESULTS.event_occurred, ended)
        counts = jnp.stack([rejected, made + 1])
        state = _Pace(jnp.where(keep, ratio, before), counts, step, last)
        return keep, start, start + h, False, state, ended

    def _norm(self, tree, size):
        """Root mean square of `tree` in units of the tolerances at values of `size`."""
        rtol, atol = (_spread(x, size) for x in (self.rtol, self.atol))
        parts = jax.tree.map(lambda e, s, r, a: (e / (a + r * s)) ** 2, tree, size, rtol, atol)
        leaves = [part.reshape(-1) for part in jax.tree.leaves(parts)]
        if not leaves:
            return jnp.zeros(())
        total = sum(jnp.sum(leaf) for leaf in leaves)
        return jnp.sqrt(total / max(1, sum(leaf.size for leaf in leaves)))

    def _first(self, terms, t0, limit, y0, args, func, error_order):
        """A first step, at most `limit`, after Hairer, Norsett and Wanner, section II.4."""
        size = jax.tree.map(jnp.abs, y0)
        rate = func(terms, t0, y0, args)
        d0, d1 = self._norm(y0, size), self._norm(rate, size)
        small = (d0 < 1e-5) | (d1 < 1e-5)
        h = jnp.where(small, 1e-6, 0.01 * d0 / jnp.where(d1 > 0, d1, 1.0))
        limit = jnp.abs(limit)
        h = jnp.minimum(h, limit)
        near = jax.tree.map(lambda y, k: y + h * k, y0, rate)
        turn = jax.tree.map(lambda a, b: a - b, func(terms, t0 + h, near, args), rate)
        d2 = self._norm(turn, size) / jnp.where(h > 0, h, 1.0)
        largest = jnp.maximum(d1, d2)
        rough = jnp.where(largest > 0, largest, 1.0)
        longer = jnp.where(
            largest <= 1e-15, jnp.maximum(1e-6, 1e-3 * h), (0.01 / rough) ** (1 / error_order)
        )
        h = jnp.minimum(jnp.minimum(100 * h, longer), limit)
        return jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-6 * limit)


def _spread(tolerance: PyTree, like: PyTree) -> PyTree:
    """One tolerance per leaf, from a single number or a tree of the same structure."""
    if jax.tree.structure(tolerance) == jax.tree.structure(0.0):
        return jax.tree.map(lambda _: tolerance, like)
    if jax.tree.structure(tolerance) != jax.tree.structure(like):
        raise ValueError(
            f"Control: a tolerance has the structure {jax.tree.structure(tolerance)}, the "
            f"state {jax.tree.structure(like)}. Give a number or one number per leaf."
        )
    return tolerance


# Steps that may fail: halved until they converge, and grown again afterwards


#: (given, offset, size, state) -> state after a step of `size` at `offset`, converged or not.
Attempt = Callable[[Any, Array, Array, PyTree], tuple[PyTree, Bool[Array, ""]]]


class SearchedAttempt(NamedTuple):
    """An attempt as a search, and a step that knows what was found.

    Attributes:
        search: (given, offset, size, state) -> the unknowns, found or not; without derivative.
        step: (given, offset, size, state, unknowns) -> state after the step, whose derivative
            is that of the equations at the unknowns.
    """

    search: Callable[[Any, Array, Array, PyTree], tuple[PyTree, Bool[Array, ""]]]
    step: Callable[[Any, Array, Array, PyTree, PyTree], PyTree]


_ROWS = 32  # parts of a step at most
_BLOCK = 8  # of which as many are replayed together


class _Walk(NamedTuple):
    """A step on its way: what is done of it, in parts whose ends `ends` holds, and the
    unknowns of the parts where those are kept."""

    state: PyTree
    done: Float[Array, ""]
    share: Float[Array, ""]
    failures: Int[Array, ""]
    row: Int[Array, ""]
    ends: Float[Array, " rows"]
    unknowns: PyTree
    running: Bool[Array, ""]


@eqx.filter_custom_jvp
def cut(
    attempt: Attempt | SearchedAttempt,
    max_cuts: int,
    given: PyTree,
    h: Float[Array, ""],
    state: PyTree,
) -> tuple[PyTree, Bool[Array, ""]]:
    """The state after a step of `h`, taken in parts where it does not converge whole.

    A part that fails is halved, at most `max_cuts` times in a row, and parts grow again
    afterwards. A part that did not converge is never accepted: where the end is not reached
    the state before the step comes back, and False.

    Derivatives are those of the parts that were taken; their choice has none. `attempt`
    closes over nothing that is differentiated. The derivative of a `SearchedAttempt` searches
    once; of another one a step that is whole is made once, others twice.
    """
    walk = _walked(attempt, max_cuts, given, h, state)
    return _held(walk, walk.state, state)


@cut.def_jvp
def _cut_jvp(primals, tangents):
    attempt, max_cuts, given, h, state = primals

    def in_parts():
        walk = _walked(attempt, max_cuts, given, h, state, keep=True)
        ends, unknowns = jax.lax.stop_gradient((walk.ends, walk.unknowns))

        def replayed(given, h, state):
            return _replay(attempt, ends, unknowns, given, h, state)

        moved = eqx.filter_jvp(replayed, primals[2:], tangents[2:])[1]
        reached = walk.done >= 1.0
        kept = jax.tree.map(lambda a: jnp.where(reached, a, jnp.zeros_like(a)), moved)
        return _held(walk, walk.state, state), kept

    if isinstance(attempt, SearchedAttempt):
        values, moved = in_parts()
        return values, (moved, None)

    def whole(given, h, state):
        return attempt(given, jnp.zeros_like(h), h, state)

    (new, converged), (moved, _) = eqx.filter_jvp(whole, primals[2:], tangents[2:])
    fine = _fine(new, converged)
    # most steps are whole, whose derivative needs no replay
    return_whole = (new, fine), moved
    values, moved = jax.lax.cond(any_of_lanes(~fine), in_parts, lambda: return_whole)
    return values, (moved, None)


def filled(values: PyTree, tangents: PyTree) -> PyTree:
    """Tangents of `values`, zeros where there is none."""

    def one(value, tangent):
        return jnp.zeros_like(value) if tangent is None else tangent

    return jax.tree.map(one, values, tangents, is_leaf=lambda x: x is None)


def _fine(new: PyTree, converged: Bool[Array, ""]) -> Bool[Array, ""]:
    return converged & finite(eqx.filter(new, eqx.is_inexact_array))


def _held(walk: _Walk, new: PyTree, old: PyTree):
    reached = walk.done >= 1.0
    return jax.tree.map(lambda a, b: jnp.where(reached, a, b), new, old), reached


def halved(share, failures, max_cuts: int):
    """Size of the part after one that failed, failures in a row, and whether to go on."""
    return share / 2, failures + 1, failures < max_cuts


def may_double(share, end):
    """Whether a part twice as large as `share` of a step may follow at `end`: it fits in."""
    return (2 * share <= 1.0) & (end % (2 * share) == 0.0)


def _walked(attempt, max_cuts: int, given, h, state, keep: bool = False) -> _Walk:
    def one_pass(walk: _Walk) -> _Walk:
        at = given, walk.done * h, walk.share * h, walk.state
        new, converged, unknowns = _tried(attempt, at)
        fine = _fine(new, converged)
        end = walk.done + walk.share
        grown = jnp.where(may_double(walk.share, end), 2 * walk.share, walk.share)
        rows = walk.unknowns
        if keep:
            rows = jax.tree.map(lambda a, x: a.at[walk.row].set(x), rows, unknowns)
        accepted = _Walk(
            new,
            end,
            grown,
            jnp.zeros_like(walk.failures),
            walk.row + 1,
            walk.ends.at[walk.row].set(end),
            rows,
            (end < 1.0) & (walk.row + 1 < _ROWS),
        )
        share, failures, running = halved(walk.share, walk.failures, max_cuts)
        cut = walk._replace(share=share, failures=failures, running=running, unknowns=rows)
        return jax.tree.map(lambda a, b: jnp.where(fine, a, b), accepted, cut)

    zero, none = jnp.zeros_like(h), jnp.zeros((), jnp.int32)
    ends = jnp.zeros(_ROWS, h.dtype)
    rows = None
    if keep:
        one = jax.eval_shape(lambda: _tried(attempt, (given, zero, h, state))[2])
        rows = jax.tree.map(lambda x: jnp.zeros((_ROWS, *x.shape), x.dtype), one)
    begin = _Walk(state, zero, zero + 1, none, none, ends, rows, jnp.array(True))
    return jax.lax.while_loop(lambda walk: walk.running, one_pass, begin)


def _tried(attempt, at) -> tuple[PyTree, Bool[Array, ""], PyTree]:
    """The state after a part, whether it converged, and the unknowns of a search."""
    if isinstance(attempt, SearchedAttempt):
        unknowns, converged = attempt.search(*at)
        return attempt.step(*at, unknowns), converged, unknowns
    return *attempt(*at), None


def _replay(attempt, ends, unknowns, given, h, state) -> PyTree:
    """The parts of a walk again, in a loop of known length."""
    starts = jnp.concatenate([jnp.zeros_like(ends[:1]), ends[:-1]])
    # what a lane does that has no part where others of a batch have one, for nothing: a part
    # known to converge, as no derivative may be NaN
    first = jnp.zeros_like(h), jnp.where(ends[0] > 0, ends[0], 1.0)
    first = *first, jax.tree.map(lambda x: x[0], unknowns), state

    def one(now, row):
        start, end, taken, known = row

        def moved():
            mine = end > start
            part = start, end, known, now
            begin, stop, found, at = _where(mine, part, first)
            at = given, begin * h, (stop - begin) * h, at
            if isinstance(attempt, SearchedAttempt):
                new = attempt.step(*at, found)
            else:
                new = attempt(*at)[0]
            return _where(mine, new, now)

        return jax.lax.cond(taken, moved, lambda: now), None

    # only the states between the parts are kept for a derivative in reverse
    part = jax.checkpoint(one, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]

    def one_block(now, rows):
        def replayed():
            return jax.lax.scan(part, now, rows)[0]

        return jax.lax.cond(rows[2][0], replayed, lambda: now), None

    # in blocks, as few steps have more parts than one block
    rows = starts, ends, any_of_lanes(ends > starts), unknowns
    blocks = jax.tree.map(lambda x: x.reshape(_ROWS // _BLOCK, _BLOCK, *x.shape[1:]), rows)
    return jax.lax.scan(one_block, state, blocks)[0]


# Whether the steps of a run are short enough: a few of them made as two halves too


_FEWEST_ROWS = 160  # where a run has as many steps, so that checks cost a twentieth at most
_ROWS_PER_CHECK = 400
_FEWEST_STEPS = 8  # of a run that is judged
_LIMIT = 0.7  # of the motion
_COARSE = 0.4  # of what a row moved: then errors no longer follow the order of a method
_ROUNDING = 0.6  # power of the unit roundoff: what two ways of a step may differ by


class Passes(NamedTuple):
    """The outputs of a scan, in order.

    Attributes:
        row: Number of the row.
        part: 1 and 2 the halves of a row that is judged, 0 the whole row, after them.
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

    @property
    def opens(self) -> np.ndarray:
        """Whether a pass is the first one of its row."""
        return np.diff(self.row, prepend=-1) > 0


class Doubled(NamedTuple):
    """The state of a run that takes some of its rows by halves too: now, and where the last
    pass ended."""

    now: PyTree
    last: PyTree

    @classmethod
    def at(cls, state: PyTree) -> "Doubled":
        """A run that begins."""
        return cls(state, jax.lax.stop_gradient(state))

    def begin(self, part: Array) -> PyTree:
        """The start of a pass."""
        return _where(part == 2, self.last, self.now)

    def end(self, part: Array, new: PyTree) -> "Doubled":
        """The same after a pass to `new`."""
        return Doubled(_where(part == 0, new, self.now), jax.lax.stop_gradient(new))


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
        order = np.lexsort(((part - 1) % 3, row))
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
    """The outputs stacked over all passes, for those of whole rows."""
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
