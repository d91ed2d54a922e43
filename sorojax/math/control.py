"""Step size control of adaptive runs: proportional-integral, tolerances per component."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int, PyTree

from sorojax._types import optional_real, real


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
    """What the control remembers: error of the last step, rejections in a row and attempts,
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
        """What to remember in order to take the step of `seam` again and go on."""
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
        ratio = jax.lax.stop_gradient(self._ratio(y0, y1_candidate, y_error))
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

    def _ratio(self, y0, y1, error):
        size = jax.tree.map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), y0, y1)
        return self._norm(error, size)

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
