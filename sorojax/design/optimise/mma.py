"""The method of moving asymptotes and its globally convergent version.

A step replaces objective and constraints by separable convex functions with asymptotes L and
U on both sides of each variable,

    min sum p_0/(U - x) + q_0/(x - L) + z + sum c y + y^2/2, so that
    sum p_i/(U - x) + q_i/(x - L) - y_i <= b_i, least <= x <= most, y >= 0, z >= 0,

and solves that problem by a primal-dual interior-point method whose systems have the size of
the number of constraints.

References:
    Svanberg, "The method of moving asymptotes - a new method for structural
    optimization", Int. J. Numer. Meth. Engng 24, 1987.
    Svanberg, "A class of globally convergent optimization methods based on conservative
    convex separable approximations", SIAM J. Optim. 12, 2002.
    Svanberg, "MMA and GCMMA - two methods for nonlinear optimization", KTH Stockholm, 2007,
    for the perturbed optimality conditions and their reduction.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sorojax._types import real
from sorojax.design.optimise.base import AbstractOptimiser, Values

_INNER = 15  # proposals of GCMMA for one step
_CLOSER = 3.0  # times the curvature after a proposal that is not finite; 3**15 is 1e7
_ROUNDING = 4  # of rounding, of the terms of an approximation: what a function may lie above it
_PRICE = 1000.0  # of breaking a constraint, against objectives of order one to a hundred


class Approximation(NamedTuple):
    """Row 0 of `p` and `q` is the objective; `right` are the b_i, and `shift_objective` is
    what the approximate objective has in excess of the true one at the expansion point."""

    p: Float[Array, "functions n"]
    q: Float[Array, "functions n"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    least: Float[Array, " n"]
    most: Float[Array, " n"]
    right: Float[Array, " m"]
    shift_objective: Float[Array, " 1"]

    def at(self, x: Float[Array, " n"]) -> Float[Array, " functions"]:
        """The sums at `x`."""
        return self.p @ (1 / (self.high - x)) + self.q @ (1 / (x - self.low))


class _Point(NamedTuple):
    """Primal variables, multipliers and slacks; all but x are positive."""

    x: Array
    y: Array
    z: Array
    lam: Array
    xsi: Array
    eta: Array
    mu: Array
    zeta: Array
    s: Array


def solve_subproblem(task: Approximation) -> Float[Array, " n"]:
    """The minimiser: by its one multiplier where there is one constraint, otherwise by
    Newton's method on conditions whose perturbation goes to 1e-7."""
    if task.right.shape[0] <= 1:
        return solve_dual(task)
    return solve_primal_dual(task)


def solve_dual(task: Approximation) -> Float[Array, " n"]:
    """The minimiser under at most one constraint. For a multiplier every x is known in closed
    form, and what the constraint has in excess falls with it: the root of one function.

    Reference: Svanberg, Int. J. Numer. Meth. Engng 24, 1987, section 4.
    """
    if not task.right.shape[0]:
        return _minimiser(task, task.p[0], task.q[0])
    price = jnp.asarray(_PRICE, task.p.dtype)

    def excess(lam):
        p, q = task.p[0] + lam * task.p[1], task.q[0] + lam * task.q[1]
        x = _minimiser(task, p, q)
        up, down = 1 / (task.high - x), 1 / (x - task.low)
        slope = task.p[1] * up**2 - task.q[1] * down**2
        curvature = 2 * (p * up**3 + q * down**3)
        free = (x > task.least) & (x < task.most)
        rate = -jnp.sum(jnp.where(free, slope**2 / curvature, jnp.zeros_like(x)))
        value = jnp.sum(task.p[1] * up + task.q[1] * down) - task.right[0]
        broken = jnp.maximum(lam - price, 0.0)
        return x, value - broken, rate - (broken > 0).astype(x.dtype)

    def improve(state):
        lam, low, high, _, _, count = state
        x, value, rate = excess(lam)
        low, high = jnp.where(value > 0, lam, low), jnp.where(value > 0, high, lam)
        step = lam - value / rate
        far = jnp.where(jnp.isfinite(high), (low + high) / 2, 8 * low + 1e-3)
        far = jnp.where(low > 0, jnp.where(jnp.isfinite(high), jnp.sqrt(low * high), far), far)
        inside = (step > low) & (step < jnp.minimum(high, 64 * low + 1e3))
        new = jnp.where(inside, step, far)
        done = ((lam == 0) & (value <= 0)) | (jnp.abs(new - lam) <= 1e-13 * lam)
        return new, low, high, x, done, count + 1

    zero = jnp.zeros_like(price)
    start = (zero, zero, zero + jnp.inf, task.least, jnp.asarray(False), 0)
    end = jax.lax.while_loop(lambda s: ~s[4] & (s[5] < 100), improve, start)
    return end[3]


def _minimiser(task: Approximation, p, q) -> Float[Array, " n"]:
    """Of p/(U - x) + q/(x - L) for each variable alone."""
    a, b = jnp.sqrt(p), jnp.sqrt(q)
    return jnp.clip((a * task.low + b * task.high) / (a + b), task.least, task.most)


def solve_primal_dual(task: Approximation) -> Float[Array, " n"]:
    """The minimiser under any number of constraints."""
    dtype, m = task.p.dtype, task.right.shape[0]
    one, x = jnp.ones(m, dtype), (task.least + task.most) / 2
    room = jnp.maximum(task.most - task.least, 1e-12)
    start = _Point(
        x,
        one,
        jnp.ones((), dtype),
        one,
        jnp.maximum(1.0, 2 / room),
        jnp.maximum(1.0, 2 / room),
        jnp.maximum(one, _PRICE / 2),
        jnp.ones((), dtype),
        one,
    )

    def tighten(state):
        point, epsilon = state
        point, _, _ = jax.lax.while_loop(
            lambda s: (s[1] > 0.9 * epsilon) & (s[2] < 200),
            lambda s: _newton(task, s[0], epsilon, s[2]),
            (point, jnp.max(jnp.abs(_residual(task, point, epsilon))), 0),
        )
        return point, 0.1 * epsilon

    point, _ = jax.lax.while_loop(
        lambda s: s[1] > 0.9e-7, tighten, (start, jnp.ones((), dtype))
    )
    return jnp.clip(point.x, task.least, task.most)


def _slopes(task: Approximation, at: _Point):
    """Lagrangian and constraints: derivative in x, curvature, values, their derivatives."""
    up, down = 1 / (task.high - at.x), 1 / (at.x - task.low)
    p, q = task.p[0] + at.lam @ task.p[1:], task.q[0] + at.lam @ task.q[1:]
    slope = p * up**2 - q * down**2
    curvature = 2 * (p * up**3 + q * down**3)
    values = task.p[1:] @ up + task.q[1:] @ down
    return slope, curvature, values, task.p[1:] * up[None] ** 2 - task.q[1:] * down[None] ** 2


def _residual(task: Approximation, at: _Point, epsilon) -> Array:
    slope, _, values, _ = _slopes(task, at)
    parts = (
        slope - at.xsi + at.eta,
        _PRICE + at.y - at.mu - at.lam,
        (1 - at.zeta)[None],
        values - at.y + at.s - task.right,
        at.xsi * (at.x - task.least) - epsilon,
        at.eta * (task.most - at.x) - epsilon,
        at.mu * at.y - epsilon,
        (at.zeta * at.z - epsilon)[None],
        at.lam * at.s - epsilon,
    )
    return jnp.concatenate(parts)


def _newton(task: Approximation, at: _Point, epsilon, count):
    """One damped step; the norm of the residual does not grow."""
    move = _direction(task, at, epsilon)
    size = jnp.linalg.norm(_residual(task, at, epsilon))
    length = _longest(task, at, move)

    def moved(t):
        return jax.tree.map(lambda a, b: a + t * b, at, move)

    def grows(state):
        t, tries = state
        return (jnp.linalg.norm(_residual(task, moved(t), epsilon)) > size) & (tries < 50)

    length, _ = jax.lax.while_loop(grows, lambda s: (s[0] / 2, s[1] + 1), (length, 0))
    new = moved(length)
    return new, jnp.max(jnp.abs(_residual(task, new, epsilon))), count + 1


def _direction(task: Approximation, at: _Point, epsilon) -> _Point:
    slope, curvature, values, slopes = _slopes(task, at)
    left, right = at.x - task.least, task.most - at.x
    dx = slope - epsilon / left + epsilon / right
    dy = _PRICE + at.y - at.lam - epsilon / at.y
    dlam = values - at.y - task.right + epsilon / at.lam
    stiff_x = curvature + at.xsi / left + at.eta / right
    stiff_y = 1 + at.mu / at.y
    # z enters no constraint, so the system is that of the multipliers
    matrix = jnp.diag(at.s / at.lam + 1 / stiff_y) + (slopes / stiff_x[None]) @ slopes.T
    lam = jnp.linalg.solve(matrix, dlam + dy / stiff_y - slopes @ (dx / stiff_x))
    x = -(dx + lam @ slopes) / stiff_x
    y = (lam - dy) / stiff_y
    z = (epsilon / at.z - 1) * at.z / at.zeta
    return _Point(
        x,
        y,
        z,
        lam,
        epsilon / left - at.xsi - at.xsi * x / left,
        epsilon / right - at.eta + at.eta * x / right,
        epsilon / at.y - at.mu - at.mu * y / at.y,
        epsilon / at.z - at.zeta - at.zeta * z / at.z,
        epsilon / at.lam - at.s - at.s * lam / at.lam,
    )


def _longest(task: Approximation, at: _Point, move: _Point) -> Array:
    """How far all positive numbers stay positive, at most 1."""
    pairs = [
        (at.y, move.y), (at.z[None], move.z[None]), (at.lam, move.lam), (at.xsi, move.xsi),
        (at.eta, move.eta), (at.mu, move.mu), (at.zeta[None], move.zeta[None]),
        (at.s, move.s), (at.x - task.least, move.x), (task.most - at.x, -move.x),
    ]  # fmt: skip
    worst = [jnp.max(-1.01 * change / value, initial=1.0) for value, change in pairs]
    return 1 / jnp.max(jnp.stack(worst))


# The method of moving asymptotes and its globally convergent version


class MMAState(eqx.Module):
    """Memory of the method: asymptotes, the last two designs, how often it was called; and for
    GCMMA how curved its functions must be, and whether they lay above the true ones."""

    low: Float[Array, " n"]
    high: Float[Array, " n"]
    last: Float[Array, " n"]
    before: Float[Array, " n"]
    count: Int[Array, ""]
    curvature: Float[Array, " functions"]
    held: Bool[Array, ""]


class AbstractMMA(AbstractOptimiser):
    """Common part of both versions: bounds, asymptotes and the convex functions."""

    lower: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    upper: Float[Array, "..."] = eqx.field(converter=real, default=1.0)
    move: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    spread: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    approach: Float[Array, ""] = eqx.field(converter=real, default=0.7)
    retreat: Float[Array, ""] = eqx.field(converter=real, default=1.2)

    @abc.abstractmethod
    def _curvature(self, state: MMAState) -> Array:
        """Least curvature of each function."""

    def init(self, x: Float[Array, " n"], constraints: int) -> MMAState:
        """State before the first step from `x` with so many constraints."""
        x = real(x)
        curvature = jnp.ones(constraints + 1, x.dtype)
        return MMAState(x, x, x, x, jnp.zeros((), jnp.int32), curvature, jnp.array(True))

    def propose(
        self, x: Float[Array, " n"], values: Values, state: MMAState
    ) -> tuple[Float[Array, " n"], MMAState]:
        """The design that minimises the convex functions, and the state after it."""
        return _propose(self, real(x), Values(*map(real, values)), state)


class MMA(AbstractMMA):
    """Moving asymptotes.

    Attributes:
        lower, upper: Bounds of the variables, numbers or one per variable.
        move: Largest change of a variable in a step, relative to its range.
        spread: Distance of the first asymptotes, relative to the range.
        approach, retreat: How asymptotes move in on variables that oscillate, and away.
    """

    def _curvature(self, state):
        return jnp.full_like(state.curvature, 1e-5)

    def update(self, x, values, memory, evaluate=None):
        return self.propose(x, values, memory)


class GCMMA(AbstractMMA):
    """Moving asymptotes whose functions are made to lie above the true ones.

    Each proposal is evaluated and made again with more curvature (`stiffen`) until they do, so
    the objective of feasible designs never rises. A proposal where a function is not finite
    counts as one where they do not.

    Attributes:
        lower, upper: Bounds of the variables, numbers or one per variable.
        move: Largest change of a variable in a step, relative to its range, by default all.
        spread: Distance of the first asymptotes, relative to the range.
        approach, retreat: How asymptotes move in on variables that oscillate, and away.
    """

    move: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def _curvature(self, state):
        return state.curvature

    def update(self, x, values, memory, evaluate):
        memory = self.begin(x, values, memory)
        new, after = self.propose(x, values, memory)
        for _ in range(_INNER):
            memory, held = self.stiffen(x, new, values, evaluate(new), memory)
            after = eqx.tree_at(lambda s: s.held, after, held)
            if bool(held):
                break
            new, after = self.propose(x, values, memory)
        return new, after

    def is_settled(self, memory):
        return bool(memory.held)

    def begin(self, x: Float[Array, " n"], values: Values, state: MMAState) -> MMAState:
        """The state at the start of an outer step: curvature by the gradients there."""
        span = self.upper - self.lower + jnp.zeros_like(x)
        slopes = jnp.concatenate([values.gradient[None], values.slopes])
        first = 0.1 / x.shape[0] * jnp.sum(jnp.abs(slopes) * span[None], axis=1)
        return eqx.tree_at(lambda s: s.curvature, state, jnp.maximum(first, 1e-6))

    def stiffen(
        self,
        x: Float[Array, " n"],
        proposal: Float[Array, " n"],
        values: Values,
        found: tuple[Float[Array, ""], Float[Array, " m"]],
        state: MMAState,
    ) -> tuple[MMAState, Array]:
        """More curvature where a function lies above its approximation at `proposal`, where
        objective and constraints were found, of all functions where one is not finite; and
        whether none does."""
        return _stiffen(self, x, proposal, values, found, state)


@jax.jit
def _propose(method, x, values: Values, state: MMAState):
    low, high = _asymptotes(method, x, state)
    answer = solve_subproblem(_approximation(method, x, values, state, low, high))
    count, held = state.count + 1, jnp.array(False)
    new = MMAState(low, high, x, state.last, count, state.curvature, held)
    return answer, new


@jax.jit
def _stiffen(method, x, proposal, values, found, state):
    low, high = _asymptotes(method, x, state)
    model = _approximation(method, x, values, state, low, high)
    true = jnp.concatenate([found[0][None], found[1]])
    sums, shift = model.at(proposal), jnp.concatenate([model.shift_objective, model.right])
    above = true - (sums - shift)
    span = method.upper - method.lower + jnp.zeros_like(x)
    away = (high - low) * (proposal - x) ** 2
    away = jnp.sum(away / ((high - proposal) * (proposal - low) * span))
    # Where a function is not defined all get stiffer: the next proposal is closer.
    outside = ~jnp.all(jnp.isfinite(true))
    noise = float(jnp.finfo(x.dtype).eps) * (sums + jnp.abs(shift) + jnp.abs(true))
    allowed = jnp.maximum(1e-7 * jnp.maximum(jnp.abs(true), 1e-7), _ROUNDING * noise)
    short = outside | (above > allowed)
    more = state.curvature + above / jnp.maximum(away, 1e-30)
    more = jnp.minimum(1.1 * more, 10 * state.curvature)
    more = jnp.where(outside, _CLOSER * state.curvature, more)
    curvature = jnp.where(short, more, state.curvature)
    return eqx.tree_at(lambda s: s.curvature, state, curvature), ~jnp.any(short)


def _asymptotes(method, x, state: MMAState) -> tuple[Array, Array]:
    span = method.upper - method.lower + jnp.zeros_like(x)
    turn = (x - state.last) * (state.last - state.before)
    gain = jnp.where(turn > 0, method.retreat, jnp.where(turn < 0, method.approach, 1.0))
    low = jnp.clip(x - gain * (state.last - state.low), x - 10 * span, x - 0.01 * span)
    high = jnp.clip(x + gain * (state.high - state.last), x + 0.01 * span, x + 10 * span)
    early = state.count < 2
    return (
        jnp.where(early, x - method.spread * span, low),
        jnp.where(early, x + method.spread * span, high),
    )


def _approximation(method, x, values: Values, state, low, high) -> Approximation:
    span = method.upper - method.lower + jnp.zeros_like(x)
    least = jnp.maximum(low + 0.1 * (x - low), x - method.move * span)
    most = jnp.minimum(high - 0.1 * (high - x), x + method.move * span)
    slopes = jnp.concatenate([values.gradient[None], values.slopes])
    up, down = jnp.maximum(slopes, 0), jnp.maximum(-slopes, 0)
    curve = method._curvature(state)[:, None] / span[None]
    p = (high - x)[None] ** 2 * (1.001 * up + 0.001 * down + curve)
    q = (x - low)[None] ** 2 * (0.001 * up + 1.001 * down + curve)
    here = p @ (1 / (high - x)) + q @ (1 / (x - low))
    return Approximation(
        p,
        q,
        low,
        high,
        jnp.maximum(least, method.lower),
        jnp.minimum(most, method.upper),
        here[1:] - values.constraints,
        here[:1] - values.objective,
    )
